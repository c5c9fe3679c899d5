"""Images and curves of faces; reports and browser pages have packages of their own."""

from torchface.rendering.compositing import caption, headed, save_rendered_image, sheet, to_pillow
from torchface.viz.figures.curves import error_curve, named_bars, weight_curves
from torchface.viz.figures.error_maps import compared_views, error_colors, error_views
from torchface.viz.figures.face_views import clay_colors, face_views, frame_face, heat_map
from torchface.viz.figures.marker_maps import marker_map, site_views
from torchface.viz.figures.model_figures import modes_figure, random_figure
from torchface.viz.figures.registration_views import registration_sheet

__all__ = [
    "caption",
    "clay_colors",
    "compared_views",
    "error_colors",
    "error_curve",
    "error_views",
    "face_views",
    "frame_face",
    "headed",
    "heat_map",
    "marker_map",
    "modes_figure",
    "named_bars",
    "random_figure",
    "registration_sheet",
    "save_rendered_image",
    "sheet",
    "site_views",
    "to_pillow",
    "weight_curves",
]

"""From photographs and a head model on disk to a personal rig on disk, with the fit drawn over each photograph."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.color_space import to_linear, to_srgb
from torchface.errors import FileFormatError
from torchface.files.whole_files import all_or_none
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.io import load_image, save_calibration, save_pts, save_rig
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.rig_files import SCENE_ENDINGS
from torchface.io.video.video_file import VIDEO_ENDINGS
from torchface.landmarks import FaceReading
from torchface.modeling import FitSettings, ImageFit, fit_images, transfer_with_report
from torchface.modeling.photographs.face_piece import FacePiece
from torchface.modeling.photographs.image_texture import without_colors
from torchface.modeling.photographs.landmark_view import JAW
from torchface.number_checks import checked_count
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import Lighting, render
from torchface.rendering.compositing import save_rendered_image
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.embedded_character import is_performers
from torchface.viz.figures.landmark_dots import with_dots
from torchface.workflows.fit.color_evidence import part_colors
from torchface.workflows.fit.fit_checks import (
    ALONE,
    counted,
    eyes_distances,
    landmark_lines,
    one_person_lines,
    strange_lines,
    width_lines,
)
from torchface.workflows.fit.fit_landmarks import (
    DEFAULT_LANDMARKS,
    PhotographLandmarks,
    check_inside,
    find_in_photographs,
    landmarks_of,
    warn_if_stored_turned,
)
from torchface.workflows.fit.fit_readings import with_readings
from torchface.workflows.fit.fitted_character import dressed_rig
from torchface.workflows.fit.picture_checks import (
    angle_lines,
    color_lines,
    cover_lines,
    edge_lines,
    forehead_lines,
    grey_lines,
    hat_lines,
    light_lines,
    picture_lines,
    without_hat,
)
from torchface.workflows.fit.sharpness_checks import sharpness_lines
from torchface.workflows.fit.video_pictures import video_pictures
from torchface.workflows.named_finders import part_finder
from torchface.workflows.named_heads import NamedHeads, load_head_model, matching
from torchface.workflows.named_priors import DEFAULT_PRIOR, load_priors
from torchface.workflows.rig.actor_rig import check_out
from torchface.workflows.rig_names import Naming, renamed

_DIMMEST, _BRIGHTEST = 0.25, 2.5  # of what a drawing's light is multiplied by
_LIGHT = Lighting(occlusion_rays=0)
_WHITE, _BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class PhotographSettings:
    """Settings of a fit to photographs on disk."""

    fit: FitSettings = field(default_factory=FitSettings)  # the noise of landmarks, the priors on faces, the skin
    # a rig with the model's topology; the model's own, or the embedded performer, if absent
    template: Path | None = None
    part: str | None = None  # an annotated region that template and model are cut to, such as `"face"` of an ICT head
    focal: float | None = None  # length in pixels, if given
    # which of several, from 0: in the order of an XML, or where landmarks are found the largest first
    face: int | None = None
    landmark_model: str | Path = DEFAULT_LANDMARKS  # finds landmarks where no file gives them; by name or folder
    names: Naming | None = None  # of the written shapes; see `rig_names.renamed`
    prior: str | Path = DEFAULT_PRIOR  # which weights faces have: a shape prior by name or folder, or "none"
    insist: bool = False  # also where photographs do not seem to show one person
    everything: bool = False  # paint hair, clothes and what hangs before the face on the head

    def __post_init__(self) -> None:
        if self.face is not None:
            checked_count("face", self.face)


_POOR = 0.04  # of the distance of the eyes' outer corners


@dataclass(frozen=True, eq=False)
class FittedHead:
    """What was made, and how near it comes to the photographs."""

    rig: BlendshapeRig
    fit: ImageFit  # see `ImageFit`
    # the files written, one a photograph: it, the fit over it, landmarks found (green) and fitted (red)
    overlays: tuple[Path, ...]
    transfer_summary: str  # on triangles without area; empty where there are none
    found: tuple[PhotographLandmarks, ...] = ()  # the landmarks that no file gave; empty where files gave them
    remarks: tuple[str, ...] = ()
    heads: str = ""  # what there is to say of the head model
    shown: tuple[Path, ...] = ()  # the photographs, and the frames of videos, by their names
    grey: bool = False  # whether all of them are black and white
    stray: bool = False  # whether given landmarks are not on a face
    dark: bool = False  # whether one of them is too dark to show the skin's colour
    focal_given: bool = False
    hats: bool = False  # whether all of them show a covered forehead

    def verdict(self) -> str:
        """Whether the head is to be used, in a line; no landmark says whether skin and likeness are right."""
        residuals = self.fit.residuals[:, JAW:].square().sum(-1).nanmean(1).sqrt()
        off = float((residuals / eyes_distances(self.fit.landmarks)).max())
        digits = 1 if f"{off:.1%}" != f"{_POOR:.1%}" else 2
        fit = f"eyes, nose and mouth lie {off:.{digits}%} of the eyes' distance from the landmarks"
        look = f"look at {self.overlays[0].name} first" if self.overlays else "look at the rig first"
        warned = sum(line.startswith("WARNING") for line in self.remarks)
        stray, dark = self.stray, self.dark
        word = "poor" if off > _POOR or stray or dark else "partly usable" if warned else "good"
        word += ", the given landmarks are not on a face that is found" if stray else ""
        word += ", too dark to show the skin's colour" if dark else ""
        more = f"; {warned} {'warnings' if warned > 1 else 'warning'} below" if warned else ""
        return f"result: {word}, {fit} (at most {_POOR:.0%} is usual){more}; {look}"

    def lines(self) -> list[str]:
        """For people to read."""
        fit, photographs = self.fit, self.shown
        lines = [self.verdict(), *([self.heads] if self.heads else [])]
        lines += [line for one in self.found for line in one.lines()]
        for i, (path, camera, error) in enumerate(zip(photographs, fit.cameras, fit.errors.tolist(), strict=True)):
            eyes = float(eyes_distances(fit.landmarks)[i])
            inner = float(fit.residuals[i, JAW:].square().sum(-1).nanmean().sqrt())
            lines.append(
                f"{path.name}: landmarks {error:.2f} pixels off ({error / eyes:.1%} of the eyes' distance; "
                f"{inner / eyes:.1%} without the contour), focal length {float(camera.intrinsics[0, 0]):.0f}"
            )
        if not self.focal_given:
            lines.append(
                "focal length: a guess by the face's perspective; two head models differ in it by a factor of 0.6 to "
                "1.8 (24 photographs), and in the distance to the camera; give --focal where you know it"
            )
        lines += [_skin_line(fit)] if len(photographs) > 1 else []
        lines += self.remarks
        most = float(fit.coefficients.abs().max())
        lines.append(f"identity: at most {most:.2f} standard deviations from the mean head in a mode; 3 are rare")
        for path, weights in zip(photographs, fit.weights, strict=True):
            strongest = weights.argsort(descending=True)[:5].tolist()
            listed = [f"{self.rig.names[k]} {float(weights[k]):.2f}" for k in strongest if float(weights[k]) > 0.05]
            lines.append(f"{path.name}: expression {', '.join(listed) or 'at rest'}")
        if fit.color is not None:
            off = float(fit.color.error.mean())
            lines.append(
                "skin that no photograph shows: the head model's colours, which differ from the skin that photographs "
                f"show by {off / 3**0.5:.0%} of full brightness"
            )
        seen = "brightness in the photographs, which show no colours" if self.grey else "colour in the photographs"
        if fit.hair is not None:
            cut = "haircut with a fringe" if fit.fringe else "haircut"
            worn = "hair" in self.rig.neutral.regions
            what = f"the template's {cut}, not the person's" if worn else "painted on the head as a cap"
            lines.append(f"hair: {_code(fit.hair)}, its {seen}; {what}")
        elif self.hats:
            lines.append("hair: covered; the template's haircut and colour")
        elif fit.mesh.texture is not None:
            lines.append("hair: none seen over the brows: bald, covered, or grey, which the network may miss")
        if fit.iris is not None:
            lines.append(f"irises: {_code(fit.iris)}, their {seen}")
        elif fit.mesh.texture is not None:
            lines.append("irises: the template's; the photographs show too little of them, or eyes too small")
        lines.append(f"rig: {len(self.rig.vertices)} vertices, {len(self.rig.names)} shapes transferred")
        return lines + ([f"  note: {self.transfer_summary}"] if self.transfer_summary else [])


def fit_photographs(
    photographs: Sequence[Path],
    landmarks: Sequence[Path],
    model: str | Path | None,
    out: Path,
    settings: PhotographSettings = PhotographSettings(),
    progress: Progress | None = None,
) -> FittedHead:
    """Fits a head to photographs of one person, each with an expression of its own, and writes it as a rig.

    Args:
        photographs: image files, or videos, of which frames are chosen.
        landmarks: files of 68 for each photograph, or one of dlib's XML; found, and written beside ``out``, if absent.
        model: a head model by name or folder; see ``zoo.get_model``. The best at hand if absent.
        out: the ``.glb`` or folder to write, see ``save_rig``; overlays are written beside it.
        settings: whose shapes, which lens, which face of several.
    """
    progress, insist = progress or silent, settings.insist
    check_out(out)
    for path in photographs:
        if path.suffix.lower() in (*MESH_ENDINGS, *SCENE_ENDINGS):
            raise FileFormatError(f"{path}: found a mesh, expected photographs; torchface rig makes a rig of a mesh")
        if not path.is_file():
            what = "a folder" if path.is_dir() else "no such file"
            raise FileFormatError(f"{path}: found {what}, expected photographs, by name, or a video")
    progress("reading the model")
    named = NamedHeads.of(model)
    heads, rig = matching(load_head_model(named.name), settings.template, settings.part)
    prior = load_priors(rig, settings.prior, None).shapes
    progress("reading the photographs")
    found, one_film, given = list[PhotographLandmarks](), False, {path.name for path in photographs}
    if landmarks or not photographs:
        images = [load_image(path) for path in photographs]
        marks = torch.stack(landmarks_of(photographs, landmarks, settings.face))
        for photograph in photographs:
            warn_if_stored_turned(photograph)
    else:
        one_film = len(photographs) == 1
        photographs, images, found = _pictures(photographs, rig, settings, progress)
        marks = torch.stack([one.confident for one in found])
    sizes = [(image.shape[2], image.shape[1]) for image in images]
    check_inside(photographs, marks, sizes)

    def bare(points: Tensor, rows: list[int]) -> ImageFit:
        some = [sizes[row] for row in rows]
        # What all found landmarks have in common must not look like one head.
        alone = replace(ALONE, annotated=bool(found))
        return fit_images(heads, rig, points, some, camera=settings.focal, settings=alone)

    progress("finding skin, hair and what covers them")
    parts = [part_finder()((255 * image[:3].clamp(0, 1)).byte(), one) for image, one in zip(images, marks, strict=True)]
    hats = [[] if settings.everything else hat_lines(*one) for one in zip(photographs, parts, marks, strict=True)]
    hatless = [without_hat(one, at) if hat else one for one, at, hat in zip(parts, marks, hats, strict=True)]
    fitting = replace(settings.fit, expression_prior=prior, annotated=bool(found))
    fitting = fitting if settings.everything else replace(fitting, parts=hatless)
    # A template that the user names is written as it is.
    worn = settings.template is None and not settings.everything and bool(fitting.texture_size) and is_performers(rig)
    fitting = replace(fitting, paint_hair=not worn)
    if found:
        readings = FaceReading.stacked([one.face for one in found])
        fitting = with_readings(fitting, readings, found[0].places, rig)
    remarks = [line for one in found for line in picture_lines(one, insist)]
    stray = dark = False
    whole = [one.face.landmarks for one in found] or marks
    for photograph, image, shown, points, every in zip(photographs, images, parts, marks, whole, strict=True):
        edge = edge_lines(photograph, (image.shape[2], image.shape[1]), every)
        remarks += [] if edge else forehead_lines(photograph, (image.shape[2], image.shape[1]), every)
        # Given landmarks may lie off the face, where grain says nothing.
        remarks += (color_lines if found else grey_lines)(photograph, image, shown, points)
        remarks += [*edge, *cover_lines(photograph, shown, points, bool(edge))]
        if not settings.everything:
            of_light, too_dark = light_lines(photograph, image, shown, points)
            remarks, dark = remarks + of_light, dark or too_dark
    remarks += sharpness_lines(photographs, images, marks) if found else []
    alone = [bare(marks[i : i + 1], [i]) for i in range(len(marks))]
    remarks += width_lines(photographs, alone, heads, rig.neutral.landmarks)
    colors = torch.stack([part_colors(*one) for one in zip(images, hatless, strict=True)])
    # Nobody can leave out a frame of a film.
    remarks += one_person_lines(photographs, marks, alone, bare, insist or one_film, colors)
    fit = fit_images(heads, rig, marks, sizes, images, settings.focal, fitting, progress)
    remarks += angle_lines(fit)
    if found:
        remarks += strange_lines(photographs, fit)
    else:
        of_landmarks, stray = landmark_lines(photographs, images, marks, settings.landmark_model, bare)
        remarks += of_landmarks
    if not stray:  # landmarks beside a face have no forehead
        remarks += [line for lines in hats for line in lines]
    transferred = transfer_with_report(rig, fit.mesh, progress=progress)
    dressed = dressed_rig(transferred.rig, rig, fit, images, hatless, marks, worn, all(hats))
    made = dressed.rig
    progress("writing the rig and the overlays")
    overlays = tuple(out.with_name(f"{out.stem}_{i + 1}_{path.stem}.png") for i, path in enumerate(photographs))
    with all_or_none():
        save_rig(renamed(made, settings.names), out, dressed.surface if out.suffix.lower() == ".glb" else None)
        for i, (path, image) in enumerate(zip(overlays, images, strict=True)):  # one photograph at a time
            save_rendered_image(overlay(fit, i, image, marks[i], made), path)
        for path, camera, (width, height), error in zip(overlays, fit.cameras, sizes, fit.errors.tolist(), strict=True):
            lens = camera.intrinsics.double(), torch.zeros(5).double()
            calibration = CameraCalibration(*lens, width, height, error, settings.focal is None)
            save_calibration(calibration, path.with_suffix(".toml"))
        for path, one in zip(overlays, found, strict=False):  # to be corrected and given as --landmarks
            save_pts(one.face.landmarks, path.with_suffix(".pts"))
    summary = transferred.report.summary()
    return FittedHead(
        made,
        fit,
        overlays,
        summary,
        tuple(found),
        tuple(counted(remarks, {path.name for path in photographs} - given)),
        named.line,
        tuple(photographs),
        without_colors(images),
        stray,
        dark,
        settings.focal is not None,
        worn and all(hats),
    )


def _pictures(
    paths: Sequence[Path], rig: BlendshapeRig, settings: PhotographSettings, progress: Progress
) -> tuple[list[Path], list[Tensor], list[PhotographLandmarks]]:
    """Photographs and frames of videos, by name, with their landmarks found."""
    names, images, found = list[Path](), list[Tensor](), list[PhotographLandmarks]()
    progress("finding landmarks in the photographs")
    for path in paths:
        if path.suffix.lower() in VIDEO_ENDINGS:
            rest = rig.vertices[rig.neutral.landmarks].detach()
            some = video_pictures(path, rest, progress, settings.landmark_model, settings.face)
            names, images, found = names + some.names, images + some.images, found + some.found
            continue
        names, images = [*names, path], [*images, load_image(path)]
        found += find_in_photographs([path], images[-1:], settings.landmark_model, settings.face)
    return names, images, found


def overlay(fit: ImageFit, view: int, image: Tensor, marks: Tensor, rig: BlendshapeRig | None = None) -> Tensor:
    """A photograph, the head before it with its skin, and landmarks (68,2): found green, fitted red; (3,H,W), cut to
    it."""
    piece = FacePiece.around(image, marks)
    camera, shown = piece.camera(fit.cameras[view]), piece.image
    posed = fit.posed[view]
    if rig is not None:
        weights = torch.zeros(1, len(rig.names))
        weights[0, : fit.weights.shape[1]] = fit.weights[view]
        posed = rig.neutral.with_vertices(rig(weights)[0].detach())
    before, drawn = (render(posed, camera, lighting=_LIGHT, background=color) for color in (_WHITE, _BLACK))
    dots = (piece.from_photograph(points) for points in (marks, fit.landmarks[view]))
    dotted = with_dots((255 * shown).byte(), *dots)
    through = (before - drawn).mean(0)  # the share of what lies behind
    inner = piece.from_photograph(fit.landmarks[view, JAW:])
    over = _as_bright(drawn, shown, through < 0.5, inner.amin(0), inner.amax(0)) + through * shown
    return torch.cat([shown, over, dotted / 255], dim=2)


def _as_bright(drawn: Tensor, photograph: Tensor, shown: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """A drawing (3,H,W) as bright as the photograph is over the face, which it shows between two pixels (2,)."""
    rows, columns = (torch.arange(size, dtype=low.dtype) for size in shown.shape)
    face = shown & ((rows > low[1]) & (rows < high[1]))[:, None] & ((columns > low[0]) & (columns < high[0]))
    if not bool(face.any()):
        return drawn
    seen, made = (float(to_linear(one).mean(0)[face].median()) for one in (photograph, drawn))
    return to_srgb((to_linear(drawn) * max(_DIMMEST, min(seen / max(made, 1e-3), _BRIGHTEST))).clamp(0, 1))


def _skin_line(fit: ImageFit) -> str:
    """Whether several photographs show the head's form by more than landmarks."""
    found = fit.agreement
    if found is None:
        return (
            "skin: moved nothing: the head agrees with it already, or the photographs' expression, light or sharpness "
            "differ, or their angles are alike; the head's form rests on landmarks. Sharp photographs at rest and in "
            "one light, from the front and 20 to 30 degrees from both sides, show it better"
        )
    moved = float(found.moved[fit.mesh.landmarks.cpu()].norm(dim=1).mean())
    return (
        f"skin: {found.matches} places that photographs show together moved the face by {moved:.1f} mm; they lie "
        f"{found.after:.1f} pixels from the head's (before {found.before:.1f}; a face is 250 pixels wide)"
    )


def _code(color: Tensor) -> str:
    return "#" + "".join(f"{round(255 * channel):02x}" for channel in color.tolist())

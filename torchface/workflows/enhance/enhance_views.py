"""Pictures of an enhanced animation: input, smooth and enhanced side by side, curvature, what was added."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.enhancement import EnhancementModel
from torchface.enhancement.detail.low_pass import LowPass
from torchface.enhancement.thin_shell import rigid_motion
from torchface.geometry.cameras.pinhole import Camera
from torchface.geometry.meshes.operators import triangle_areas, vertex_normals
from torchface.geometry.meshes.shell_energies import stretching_energy
from torchface.geometry.similarity import Similarity
from torchface.mesh import Annotations, Mesh
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import caption, heat_colors, sheet
from torchface.rendering.quick_clay import QuickClay
from torchface.viz.figures.error_maps import error_colors, round_maximum
from torchface.viz.figures.face_views import clay_colors, color_bar, frame_face
from torchface.workflows.enhance.coarse_animation import CoarseAnimation
from torchface.workflows.enhance.enhanced_frames import EnhancedFrames

DIVERGING = "RdBu_r"
_DETAILED = 0.25  # of the detail where there is most
_OUTERMOST = 0.005
_DOT = (60, 230, 60)
_VIDEO_HEIGHT, _MOST_DRAWN = 480, 450
_PORES_MM = 8.0  # of which the curvature pictures keep half
_CURVATURE = 0.1  # end of the colour scale, one over millimetres
_SMALL_VIEW_MM = 1.0  # end of the colour scale where pictures of many animations lie side by side
_ALIGNED_BY = 4000  # vertices, which are plenty for a rigid motion


@dataclass(frozen=True, eq=False)
class ShownFrame:
    """One frame, its head held still in the neutral's place."""

    number: int
    given: Tensor  # what the input's file holds, (N,3), millimetres; NaN points were not seen
    coarse: Tensor  # that on the model's mesh, (V,3)
    smooth: Tensor  # its low frequencies, to which detail is added, (V,3)
    enhanced: Tensor  # the result, (V,3)


def shown_frame(animation: CoarseAnimation, model: EnhancementModel, found: EnhancedFrames, number: int) -> ShownFrame:
    """What there is of a frame."""
    coarse = animation.read(number, number + 1)
    with torch.no_grad():
        smooth = model.low(coarse)[0]
    enhanced = found.sequence.read(number, number + 1)
    given = animation.shown(number, number + 1)
    away = head_motion(enhanced, smooth)  # as the model holds the head still: what is left between both was added
    still = [away.apply(points.double())[0].float() for points in (given, coarse, enhanced)]
    return ShownFrame(number, still[0], still[1], smooth, still[2])


def head_motion(vertices: Tensor, neutral: Tensor) -> Similarity:
    """What takes the head's rigid motion from a mesh (V,3) out of meshes (t,V,3)."""
    step = max(1, len(neutral) // _ALIGNED_BY)
    return rigid_motion(neutral[::step].double(), vertices[:, ::step].double()).inverse()


def framed_model(model: EnhancementModel) -> Mesh:
    """The model's neutral, with where its detail is as its face, for cameras to look at."""
    channels = 9 if model.settings.detail == "gradients" else 3
    sites = model.components.shape[1] // channels
    spread = model.coefficients.std(0)[:, None]
    detail = (model.components.float().view(-1, channels, sites).square().sum(1) * spread.square()).sum(0).sqrt()
    detailed = detail > _DETAILED * float(detail[:: max(1, sites // 100_000)].quantile(0.98))
    if sites == len(model.faces):  # of the detail's kinds some sit on triangles
        corners = model.faces[detailed].flatten()
        detailed = torch.zeros(len(model.neutral), dtype=torch.bool)
        detailed[corners] = True
    some = model.neutral[detailed][:: max(1, int(detailed.sum()) // 100_000)]
    if len(some) > 12:
        low, high = some.quantile(_OUTERMOST, 0), some.quantile(1 - _OUTERMOST, 0)  # without a few far away
        detailed &= ((model.neutral >= low) & (model.neutral <= high)).all(1)
    regions = {"face": detailed} if int(detailed.sum()) > len(detailed) // 50 else {}
    return Mesh(model.neutral, model.faces, annotations=Annotations(regions=regions))


def compared_frames(shown: list[ShownFrame], animation: CoarseAnimation, mesh: Mesh, height: int) -> Tensor:
    """A row a frame: input, smooth, enhanced from the front, and enhanced from three quarters; (3,H,W)."""
    rows = []
    for frame in shown:
        camera = frame_face(mesh, width=height * 4 // 5, height=height)
        side = frame_face(mesh, yaw=35.0, width=height * 4 // 5, height=height)
        clay = clay_colors(mesh)
        pictures = [
            caption(_given(frame, animation, mesh, camera), f"input, frame {frame.number}", 12),
            caption(render(mesh.with_vertices(frame.smooth), camera, clay), "smooth", 12),
            caption(render(mesh.with_vertices(frame.enhanced), camera, clay), "enhanced", 12),
            caption(render(mesh.with_vertices(frame.enhanced), side, clay), "enhanced", 12),
        ]
        rows.append(sheet(pictures, len(pictures)))
    return sheet(rows, 1)


def _given(frame: ShownFrame, animation: CoarseAnimation, mesh: Mesh, camera: Camera) -> Tensor:
    if animation.shown_faces is not None:
        given = Mesh(frame.given, animation.shown_faces)
        return render(given, camera, clay_colors(given))
    picture = (render(mesh.with_vertices(frame.coarse), camera, clay_colors(mesh)) * 255).byte()
    pixels = np.ascontiguousarray(picture.permute(1, 2, 0).numpy())
    _dots(pixels, frame.given, camera)
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255


def curvature_views(shown: list[ShownFrame], mesh: Mesh, height: int) -> Tensor:
    """A row a frame: mean curvature of smooth and enhanced without pores, folds blue and ridges red; (3,H,W)."""
    rows = []
    camera = frame_face(mesh, width=height * 4 // 5, height=height)
    without_pores = LowPass(mesh.vertices, mesh.faces, _PORES_MM)
    for frame in shown:
        pictures = []
        for title, vertices in (("smooth", frame.smooth), ("enhanced", frame.enhanced)):
            bent = without_pores(mean_curvature(vertices, mesh.faces)[None, :, None])[0, :, 0]
            colors = heat_colors(bent + _CURVATURE, 2 * _CURVATURE, DIVERGING)
            picture = render(mesh.with_vertices(vertices), camera, colors)
            pictures.append(caption(picture, f"{title}, frame {frame.number}", 12))
        rows.append(sheet(pictures, 2))
    return sheet(rows, 1)


def mean_curvature(vertices: Tensor, faces: Tensor) -> Tensor:
    """Mean curvature of every vertex, (V,), one over millimetres: positive on ridges, negative in folds.

    Source: Meyer, Desbrun, Schroeder, Barr 2003, with a third of the triangles around for the area.
    """
    stiffness = stretching_energy(vertices, faces)
    areas = torch.zeros(len(vertices), dtype=torch.float64)
    each = triangle_areas(vertices.double(), faces) / 3
    for corner in range(3):
        areas.index_add_(0, faces[:, corner], each)
    normal = torch.from_numpy(stiffness @ vertices.double().numpy()) / (2 * areas.clamp(min=1e-9)[:, None])
    return (normal * vertex_normals(vertices.double(), faces)).sum(-1).float()


def added_views(shown: list[ShownFrame], mesh: Mesh, height: int) -> Tensor:
    """How far the enhanced vertices are from the smooth ones, millimetres, a picture a frame; (3,H,W)."""
    camera = frame_face(mesh, width=height * 4 // 5, height=height)
    added = [(frame.enhanced - frame.smooth).norm(dim=-1) for frame in shown]
    largest = max(float(one[:: max(1, len(one) // 100_000)].quantile(0.99)) for one in added)
    maximum = round_maximum(largest)
    pictures = [
        caption(render(mesh.with_vertices(frame.enhanced), camera, error_colors(one, maximum, "turbo")),
                f"frame {frame.number}", 12)
        for frame, one in zip(shown, added, strict=True)
    ]  # fmt: skip
    row = sheet(pictures, len(pictures))
    return sheet([row, color_bar(maximum, "added (mm)", row.shape[1])], 2)


def small_views(frame: ShownFrame, animation: CoarseAnimation, mesh: Mesh, width: int, height: int) -> Tensor:
    """Input, enhanced, and what was added (blue 0 to red 1 mm), of one size each, in a row; (3,H,W)."""
    camera = frame_face(mesh, width=width, height=height)
    enhanced = mesh.with_vertices(frame.enhanced)
    added = error_colors((frame.enhanced - frame.smooth).norm(dim=-1), _SMALL_VIEW_MM, "turbo")
    views = [_given(frame, animation, mesh, camera), render(enhanced, camera, clay_colors(mesh))]
    return sheet([*views, render(enhanced, camera, added)], 3)


def drawn_frames(
    animation: CoarseAnimation, model: EnhancementModel, found: EnhancedFrames, mesh: Mesh
) -> tuple[int, int, Iterator[Tensor]]:
    """Input and enhanced side by side as a video: how many frames, of which every how many-th, and their pictures."""
    step = max(1, -(-animation.count // _MOST_DRAWN))
    rows = list(range(0, animation.count, step))
    camera = frame_face(mesh, width=_VIDEO_HEIGHT * 4 // 5, height=_VIDEO_HEIGHT)
    dense = QuickClay.of(mesh)

    def drawn() -> Iterator[Tensor]:
        own = None
        for t in rows:
            enhanced = found.sequence.read(t, t + 1)
            away = head_motion(enhanced, model.neutral)
            given = away.apply(animation.shown(t, t + 1).double())[0].float()
            if animation.shown_faces is None:
                coarse = away.apply(animation.read(t, t + 1).double())[0].float()
                left = dense.draw(coarse, camera)
                _dots(left, given, camera)
            else:
                own = own or QuickClay.of(Mesh(given, animation.shown_faces))
                left = own.draw(given, camera)
            right = dense.draw(away.apply(enhanced.double())[0].float(), camera)
            both = np.concatenate([left, right], axis=1)
            for x, text in ((8, f"input, frame {t}"), (camera.width + 8, "enhanced")):
                cv2.putText(both, text, (x, camera.height - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (225, 225, 225), 1,
                            cv2.LINE_AA)  # fmt: skip
            yield torch.from_numpy(both).permute(2, 0, 1)[None]

    return len(rows), step, drawn()


def _dots(pixels: np.ndarray, points: Tensor, camera: Camera) -> None:
    """Points (N,3) on a picture, drawn into it."""
    places = camera.project(points[torch.isfinite(points).all(-1)].double())
    radius = max(2, camera.height // 120)
    for x, y in places.round().long().tolist():
        if abs(x) < 2**15 and abs(y) < 2**15:
            cv2.circle(pixels, (x, y), radius, _DOT, -1, cv2.LINE_AA)

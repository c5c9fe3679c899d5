"""Checks of landmarks, images and lenses before a head is fitted to them."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchface.errors import ArgumentTypeError, ShapeError, TopologyError, ValueRangeError
from torchface.modeling.morphable.head_model import HeadModel
from torchface.modeling.photographs.fit_settings import FitSettings
from torchface.modeling.photographs.landmark_view import JAW, LANDMARKS
from torchface.rig import BlendshapeRig

_MIN_INNER = 6
_FOCAL, _FOCAL_DEVIATION = 1.5, 0.3  # of the longer side: what is assumed where nothing is known of the lens
_INSIDE = 0.5
# A brow's upper edge from its inner end, beside the middle between the eyes' outer corners and in their distance: the
# mean of people in the pictures that networks learn from.
_BROW = ((0.116, 0.192), (0.232, 0.243), (0.359, 0.268), (0.475, 0.233), (0.569, 0.155))
_BROWS = slice(17, 27)
_AROUND, _BEHIND, _ROUGH = 25.0, 12.0, 6.0  # millimetres: where it is looked for, and how far from it a vertex may lie


def checked_landmark_vertices(model: HeadModel, rig: BlendshapeRig) -> Tensor:
    """The landmark vertices (68,), of the rig, or of the model where the rig has none."""
    faces = rig.neutral.faces
    if len(model.shape.mean) != len(rig.vertices) or not torch.equal(model.faces.cpu(), faces.cpu()):
        raise TopologyError(
            f"fit_images: found a model of {len(model.shape.mean)} vertices and {len(model.faces)} triangles for a rig "
            f"of {len(rig.vertices)} and {len(faces)}, expected the same triangles"
        )
    annotated = rig.neutral.annotations.landmarks if rig.neutral.annotations is not None else None
    vertices = model.landmarks if annotated is None else annotated
    if vertices is None:
        raise ValueRangeError("landmarks: found none annotated on rig or model; expected (68,) vertex ids")
    if vertices.shape != (LANDMARKS,) or vertices.dtype != torch.int64:
        raise ShapeError(
            f"landmarks: found {tuple(vertices.shape)} of {vertices.dtype}, expected ({LANDMARKS},) of torch.int64"
        )
    if not 0 <= int(vertices.min()) <= int(vertices.max()) < len(rig.vertices):
        raise TopologyError(
            f"landmarks: found {int(vertices.min())} to {int(vertices.max())}, expected 0 to {len(rig.vertices) - 1}"
        )
    return vertices.cpu()


def annotated_vertices(mean: Tensor, landmarks: Tensor) -> Tensor:
    """The landmark vertices (68,) of a head at rest (V,3), those of the brows where annotators see brows.

    Heads are annotated anywhere on the brow's ridge: ICT-FaceKit's brows lie 8 mm higher and 6 mm wider than those of
    people in pictures, which are given here beside the eyes. The vertex nearest to each is taken.
    """
    x = mean.detach().cpu().double()
    marks = x[landmarks]
    middle, unit = marks[[36, 45]].mean(0), (marks[36] - marks[45]).norm()
    right = marks.new_tensor(_BROW).flip(0) * marks.new_tensor([-1.0, 1.0])
    places = middle[:2] + unit * torch.cat([right, marks.new_tensor(_BROW)])
    brows = marks[_BROWS]
    near = (x[None, :, 2] > brows[:, None, 2] - _BEHIND) & (torch.cdist(brows, x) < _AROUND)
    apart = torch.cdist(places, x[:, :2]).masked_fill(~near, torch.inf)
    chosen = landmarks.clone()
    chosen[_BROWS] = torch.where(apart.amin(1) < _ROUGH, apart.argmin(1), landmarks[_BROWS])
    return chosen


def checked_sizes(landmarks: Tensor, image_size: tuple[int, int] | Sequence[tuple[int, int]]) -> Tensor:
    """The photographs' sizes, (I,2): width and height."""
    if landmarks.ndim != 3 or landmarks.shape[1:] != (LANDMARKS, 2) or len(landmarks) == 0:
        raise ShapeError(
            f"landmarks: found {tuple(landmarks.shape)}, expected (I,{LANDMARKS},2) with at least one view"
        )
    sizes = torch.as_tensor(image_size, dtype=torch.float64)
    if sizes.shape not in ((2,), (len(landmarks), 2)) or not bool((sizes >= 2).all()):
        raise ShapeError(
            f"image_size: found {image_size}, expected (width, height) in pixels, once or for each of "
            f"{len(landmarks)} views"
        )
    sizes = sizes.expand(len(landmarks), 2)
    for i, (marks, size) in enumerate(zip(landmarks.double(), sizes, strict=True)):  # a view at a time, for its message
        _check_view(i, marks.cpu(), size)
    return sizes


def check_images(images: Sequence[Tensor], sizes: Tensor) -> None:
    """Refuses photographs of other sizes than (I,2), and those that are no floating-point numbers."""
    found = [tuple(image.shape) for image in images]
    expected = [(3, int(height), int(width)) for width, height in sizes.tolist()]
    if found != expected:
        raise ShapeError(f"images: found {found}, expected {expected}, as in image_size")
    for image in images:
        if not image.is_floating_point():
            raise ArgumentTypeError(f"images: found {image.dtype}, expected floating-point numbers in [0,1]")


def _check_view(i: int, marks: Tensor, size: Tensor) -> None:
    seen = torch.isfinite(marks).all(-1)
    image = f"an image of {int(size[0])} x {int(size[1])}"
    if int(seen.sum()) == 0:
        raise ValueRangeError(f"landmarks: found none in view {i}, expected at least {_MIN_INNER}; leave that view out")
    if int(seen[JAW:].sum()) < _MIN_INNER:
        raise ValueRangeError(
            f"landmarks: found {int(seen[JAW:].sum())} on brows, eyes, nose and mouth in view {i}, expected at least "
            f"{_MIN_INNER}"
        )
    low, high = marks[seen].amin(0), marks[seen].amax(0)
    found = f"({low[0]:.4g}, {low[1]:.4g}) to ({high[0]:.4g}, {high[1]:.4g})"
    if float((high - low).max()) < 4:
        raise ValueRangeError(f"landmarks: found view {i}'s from {found}, expected pixels in {image}")
    inside = ((marks[seen] > -0.1 * size) & (marks[seen] < 1.1 * size)).all(-1)
    if float(inside.double().mean()) < _INSIDE:
        raise ValueRangeError(
            f"landmarks: found view {i}'s from {found}, most of them outside {image}; expected pixels of that image"
        )


def lens(camera: float | Tensor | None, sizes: Tensor, settings: FitSettings) -> tuple[Tensor, FitSettings]:
    """Intrinsics (I,3,3), and the settings with what is known of the focal length."""
    count = len(sizes)
    if isinstance(camera, Tensor) and camera.ndim > 0:
        intrinsics = camera.detach().cpu().double()
        if intrinsics.shape not in ((3, 3), (count, 3, 3)):
            raise ShapeError(f"camera: found {tuple(camera.shape)}, expected (3,3) or ({count},3,3)")
        if not torch.isfinite(intrinsics).all() or not bool((intrinsics[..., [0, 1], [0, 1]] > 0).all()):
            raise ValueRangeError("camera: found a focal length that is not positive, expected K with positive ones")
        return intrinsics.expand(count, 3, 3), settings
    if camera is None:
        focal = _FOCAL * sizes.amax(1)
        if settings.focal_deviation == 0:
            settings = replace(settings, focal_deviation=_FOCAL_DEVIATION)
        if not bool((sizes == sizes[0]).all()):  # other sizes, other cameras or crops
            settings = replace(settings, shared_focal=False)
    else:
        focal = torch.full((count,), float(camera), dtype=torch.float64)
        if not math.isfinite(float(camera)) or not float(camera) > 0:
            raise ValueRangeError(f"camera: found a focal length of {float(camera):g}, expected positive pixels")
    intrinsics = torch.eye(3, dtype=torch.float64).repeat(count, 1, 1)
    intrinsics[:, 0, 0] = intrinsics[:, 1, 1] = focal
    intrinsics[:, :2, 2] = (sizes - 1) / 2
    return intrinsics, settings

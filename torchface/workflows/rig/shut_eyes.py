"""Eyes that a neutral scan shows shut where they are taken as open, or the other way: by its texture or by two fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchface.errors import TorchfaceError
from torchface.geometry.similarity import similarity_transform
from torchface.landmarks.images.box_landmarks import settled_face
from torchface.landmarks.images.ibug_68 import COUNT, box_around
from torchface.mesh import Mesh
from torchface.registration import Registration
from torchface.registration.scan_colors import has_colors
from torchface.rendering.clay_shading import render
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.viz.figures.face_views import frame_face
from torchface.workflows.named_finders import load_finder

_BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")
# Likelihoods of the eye network: 0.9 and more of shut eyes, 0.08 at most of open and half shut ones.
_SHUT, _OPEN, _LEAST_PRESENCE = 0.6, 0.3, 0.9
_LIDS = 2.0  # millimetres that a blink moves skin of the lids
# Mean distance of the lids in the fit with shut eyes over that with open ones: 0.07 to 0.35 where they are shut, 1.6
# and more where they are open.
_BETTER, _WORSE = 0.6, 1.6
_WIDTH, _HEIGHT = 480, 600


def with_eye_note(
    rig: BlendshapeRig,
    scan: Mesh,
    registration: Registration,
    shown: Tensor,
    other_fit: Callable[[Tensor], Registration],
) -> Registration:
    """The registration, with a note where the scan's eyes are shut though taken as open, or open though taken as shut.

    The scan's face is drawn from the front and the eye network looks at it; where the scan has no colours, or they do
    not show a face, the template is registered once more with its lids the other way.

    Args:
        rig: the template; one without shapes that shut both eyes is not judged.
        registration: of the template in the pose ``shown``.
        shown: the template's weights that the scan is taken to show, (N,).
        other_fit: registers the template at weights (N,) to the scan.
    """
    rows = mapping(rig.names, _BLINKS) > 0.5
    if not bool(rows.any(1).all()):
        return registration
    blink = rows.any(0)
    taken_shut = bool((shown[blink] > 0.5).all())
    found, how = _by_texture(scan, registration, rig), "the eye network sees"
    if found is None:
        found, how = _by_shape(rig, registration, blink, shown, other_fit, taken_shut), "the lids' shape says"
    if found is None or found == taken_shut:
        return registration
    pose = " ".join(f"{rig.names[i]}=1" for i in blink.nonzero()[:, 0].tolist())
    note = (
        f"the scan's eyes are shut, as {how}, and were taken as open: --pose {pose} gives a neutral with open eyes"
        if found
        else f"the scan's eyes are open, as {how}, and were taken as shut: leave out --pose {pose}"
    )
    record = registration.record
    return replace(registration, record=replace(record, notes=(*record.notes, f"warning: {note}")))


def _by_texture(scan: Mesh, registration: Registration, rig: BlendshapeRig) -> bool | None:
    """Whether both eyes are shut in the scan's colours; None where these do not tell."""
    marks = registration.mesh.landmarks if _has_68(registration.mesh) else None
    false = any("colours are not a face's" in note for note in registration.record.notes)
    if marks is None or false or not has_colors(scan):
        return None
    mesh = registration.mesh.vertices.detach().cpu().double()
    upright = similarity_transform(mesh[None], rig.neutral.vertices.detach().cpu().double()[None], scale=False)
    placed = scan.with_vertices(upright.apply(scan.vertices.detach().cpu().double())[0].to(scan.vertices))
    camera = frame_face(rig.neutral, width=_WIDTH, height=_HEIGHT)
    picture = (render(placed, camera, samples=1).clamp(0, 1) * 255).round().to(torch.uint8)
    box = box_around(camera.project(upright.apply(mesh[marks.cpu()])[0]).float())
    reading = settled_face(load_finder().finder, picture, box, 0.0)
    if float(reading.presence) < _LEAST_PRESENCE or not bool(torch.isfinite(reading.closed).all()):
        return None
    if bool((reading.closed > _SHUT).all()):
        return True
    return False if bool((reading.closed < _OPEN).all()) else None


def _by_shape(
    rig: BlendshapeRig,
    registration: Registration,
    blink: Tensor,
    shown: Tensor,
    other_fit: Callable[[Tensor], Registration],
    taken_shut: bool,
) -> bool | None:
    """Whether the fit with shut eyes is the better one at the lids; None where both are as good."""
    lids = rig.deltas[blink].detach().norm(dim=2).amax(0) > _LIDS
    lids = lids.to(registration.distance.device)
    try:
        other = other_fit(torch.where(blink, 0.0 if taken_shut else 1.0, shown))
    except TorchfaceError:  # what cannot be registered with other lids says nothing
        return None
    shut, open_ = (registration, other) if taken_shut else (other, registration)
    ratio = float(shut.distance[lids].mean() / open_.distance[lids].mean().clamp(min=1e-6))
    return True if ratio < _BETTER else False if ratio > _WORSE else None


def _has_68(mesh: Mesh) -> bool:
    notes = mesh.annotations
    return notes is not None and notes.landmarks is not None and len(notes.landmarks) == COUNT

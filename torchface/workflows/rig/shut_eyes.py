"""Eyes that are shut at rest: a scan's, by its texture or by two fits, and a character's, by what lies behind lids."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchface.errors import TorchfaceError
from torchface.mesh import Mesh
from torchface.modeling.rigging.eyelid_closure import SkinOfHead, eyes_seen
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.registration import Registration
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.workflows.register.scan_expression import FrontView
from torchface.workflows.rig.character_face import CharacterFace

_BLINKS, _SIDES = ("eyeBlinkLeft", "eyeBlinkRight"), ("left", "right")
# Likelihoods of the eye network: 0.9 and more of shut eyes, 0.08 at most of open and half shut ones.
_SHUT, _OPEN = 0.6, 0.3
_LIDS = 2.0  # millimetres that a blink moves skin of the lids
# Share of it that a scan must show: of an eye that it lacks a view says nothing. Of eyes that are there 0.25 and more
# of the lids were matched, as their inner sides never are; of one in a hole none.
_THERE = 0.15
# Mean distance of an eye's lids in the fit with shut eyes over that with open ones, of ICT's heads: with ICT's template
# 0.25 to 0.60 where they are shut (3 heads), 1.98 and more where they are open (3); with the performer's 0.52 to 0.61
# where they are shut (2) and 0.55 to 1.81 where they are open (11), which says little.
_BETTER, _WORSE = 0.5, 1.6
_BLINKS_OF = ("Right", "Left")  # in the order of iBUG's eyes
_BALL, _HIDDEN = 2.6, 0.75  # radii of a reference's eyeball; the share of a ball's front that skin covers
_LID = 0.3  # of a blink's longest way: from there on a vertex is of the lids alone


def with_eye_note(
    rig: BlendshapeRig,
    view: FrontView | None,
    registration: Registration,
    shown: Tensor,
    other_fit: Callable[[Tensor], Registration],
) -> Registration:
    """The registration, with a note of each eye that the scan shows shut though taken as open, or the other way.

    The eye network looks at a view of the scan; where the scan has no colours, or they do not show a face, the template
    is registered once more with its lids the other way.
    """
    blinks = mapping(rig.names, _BLINKS) > 0.5
    if not bool(blinks.any(1).all()):
        return registration
    taken = [bool((shown[blink] > 0.5).all()) for blink in blinks]
    # Lashes and what lies behind the lids move with them; no scan shows where.
    face = rig.neutral.regions.get("face", torch.ones(len(rig.vertices), dtype=torch.bool))
    lids = [
        (face & (rig.deltas[blink].detach().norm(dim=2).amax(0) > _LIDS)).to(registration.matched.device)
        for blink in blinks
    ]
    found, how = _by_texture(view), "the eye network sees"
    if found is None:
        found, how = _by_shape(lids, registration, blinks, shown, other_fit, taken), "the lids' shape says"
    there = [bool(registration.matched[skin].double().mean() > _THERE) for skin in lids]
    shut = [saw if saw is not None and on else was for was, saw, on in zip(taken, found, there, strict=True)]
    poses = [f"{rig.names[i]}=1" for i in blinks[torch.tensor(shut)].any(0).nonzero()[:, 0].tolist()]
    notes = []
    for state, (is_now, was_taken) in ((True, ("shut", "open")), (False, ("open", "shut"))):
        wrong = [i for i in range(2) if shut[i] == state != taken[i]]
        if wrong:
            eyes = "eyes are" if len(wrong) == 2 else f"{_SIDES[wrong[0]]} eye is"
            notes.append(f"the scan's {eyes} {is_now}, as {how}, and taken as {was_taken}")
    if not notes:
        return registration
    given = " ".join(f"{rig.names[i]}=1" for i in (blinks.any(0) & (shown > 0.5)).nonzero()[:, 0].tolist())
    cure = f"--pose {' '.join(poses)} gives a neutral with open eyes" if poses else f"leave out --pose {given}"
    record = registration.record
    return replace(registration, record=replace(record, notes=(*record.notes, f"warning: {'; '.join(notes)}: {cure}")))


def eyes_shut_at_rest(face: CharacterFace, reference: Mesh) -> tuple[bool, bool]:
    """Whether a character's right and left eye are modelled shut: no opening, and an eyeball under the skin."""
    vertices, faces = face.head.vertices.double(), face.head.faces
    joined = joined_vertices(vertices, faces)
    skin_part = int(joined.part[joined.faces[:, 0]].bincount().argmax())
    head = SkinOfHead(joined.vertices, joined.faces, joined.part != skin_part, joined.part)
    placed = face.found.pose.inverse().apply(face.found.points)[0]
    caster, shut = RayCaster(head.vertices, head.skin), []
    forward = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for opening, side in zip(eyes_seen(head, placed), ("right", "left"), strict=True):
        ball = reference.vertices[reference.regions[f"eyeball_{side}"]].double()
        centre = (ball.amax(0) + ball.amin(0)) / 2
        near = head.loose & ((head.vertices - centre).norm(dim=-1) < _BALL * (ball - centre).norm(dim=-1).median())
        hidden = [0.0]
        for one in head.part[near].unique().tolist() if opening is None else ():  # balls and lashes
            own = head.vertices[head.part == one]
            if bool(near[head.part == one].all()):
                front = own[own[:, 2] >= own[:, 2].median()]
                hidden.append(float(caster.occluded(front, forward.expand_as(front)).double().mean()))
        shut.append(max(hidden) > _HIDDEN)
    return shut[0], shut[1]


def with_shut_eyes(rig: BlendshapeRig, shut: tuple[bool, bool]) -> BlendshapeRig:
    """The rig whose right or left eye is shut at rest: its blink moves nothing, ``eyeWide`` opens it as far as ever.

    Lids that meet do not go further in any other shape of the eye.
    """
    vertices, deltas = rig.vertices.clone(), rig.deltas.clone()
    for side in (side for side, yes in zip(_BLINKS_OF, shut, strict=True) if yes):
        blink = deltas[rig.index([f"eyeBlink{side}"])[0]].clone()
        way = blink.norm(dim=-1, keepdim=True)
        outside = 1 - (way / (_LID * way.max())).clamp(max=1)
        others = rig.index([f"eye{what}{side}" for what in ("LookUp", "LookDown", "LookIn", "LookOut", "Squint")])
        deltas[others] *= torch.where(way > 0, outside, 1.0)
        deltas[rig.index([f"eyeWide{side}"])] -= blink
        deltas[rig.index([f"eyeBlink{side}"])] = 0.0
        vertices += blink
    return BlendshapeRig(rig.neutral.with_vertices(vertices), deltas, rig.names)


def _by_texture(view: FrontView | None) -> list[bool | None] | None:
    """Whether each eye is shut in the scan's colours, None where it is between; None where they show no face."""
    if view is None or not view.colored or not bool(torch.isfinite(view.reading.closed).all()):
        return None
    sides = [1, 0]  # the network's eyes are iBUG's, the right one first
    return [True if one > _SHUT else False if one < _OPEN else None for one in view.reading.closed[sides].tolist()]


def _by_shape(
    lids: list[Tensor],
    registration: Registration,
    blinks: Tensor,
    shown: Tensor,
    other_fit: Callable[[Tensor], Registration],
    taken: list[bool],
) -> list[bool | None]:
    """Whether the fit with a shut eye is the better one at its lids; None where both are as good."""
    other_way = shown.clone()
    for blink, was_shut in zip(blinks, taken, strict=True):
        other_way[blink] = 0.0 if was_shut else 1.0
    try:
        other = other_fit(other_way)
    except TorchfaceError:  # what cannot be registered with other lids says nothing
        return [None, None]
    found: list[bool | None] = []
    for skin, was_shut in zip(lids, taken, strict=True):
        shut, open_ = (registration, other) if was_shut else (other, registration)
        ratio = float(shut.distance[skin].mean() / open_.distance[skin].mean().clamp(min=1e-6))
        found.append(True if ratio < _BETTER else False if ratio > _WORSE else None)
    return found

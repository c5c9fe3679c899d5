"""Checks of what photographs show: a face that is large, uncovered, alone, in colour, not drawn and not filtered."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchface.color_space import to_linear
from torchface.landmarks import NoFaceError
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.landmarks.images.networks.part_network import PARTS
from torchface.modeling import ImageFit
from torchface.modeling.photographs.image_texture import GREY
from torchface.modeling.photographs.skin_light import exposure_gain, needed_gain
from torchface.workflows.fit.fit_landmarks import PhotographLandmarks

# Pixels between the outer corners of the eyes: a face 40 pixels wide has 20.
_LEAST_EYES, _FEW_EYES = 10.0, 30.0
_PRESENT = 0.5
# Degrees, and mean confidence: of 7 upright faces with the mouth covered that were found upside down at most 0.42, of
# 18 faces in photographs that were turned upside down at least 0.63.
_TILTED, _SURE_TILTED = 90.0, 0.5
_HIDDEN, _EYE_HIDDEN = 0.4, 0.3  # visibilities; those of 9 faces that nothing hides were above 0.87 and 0.91
_RIVAL = 0.5  # of the chosen face's area: another that large may be the one that is meant
# Logarithms of skin's colour, medians: the mean of red and blue over green, and blue over red. 32 faces in 13 pictures
# 0.00 to 0.16 and -0.80 to -0.23; on a toned poster -0.25 and -1.8.
_GREEN_CAST, _RED_CAST = (-0.12, 0.20), (-1.2, -0.18)
# Logarithms of colours: blue over green of the brighter whites of eyes, of 33 faces at most 0.02, and red over green of
# the darker hair and brows, at least -0.06; a quantile of their brightness, and pixels.
_VIOLET_WHITES, _WHITES, _FEW_WHITES = 0.05, 0.6, 10
_TEAL_HAIR, _DARK_HAIR, _FEW_HAIRS, _HAIR = -0.10, 0.4, 30, 0.7
# Standard deviation of skin's hue where it varies least: those faces at least 0.017 (also small, blurred, compressed),
# 13 of 17 rendered ones at most 0.0125.
_ONE_HUE, _BLOTCHES = 0.0135, 0.017
# Median step from pixel to pixel on a face beside its strongest twentieth: of photographs at least 0.16, compressed
# 0.146; painted by five filters at most 0.14, by a sixth (edge-preserving) 0.18.
_PAINTED, _LEAST_STEP = 0.14, 4 / 255
_SURE = 0.9  # share of a part
_FEWEST = 100  # pixels
_FINEST = 300.0  # pixels across a face: of larger ones pixels are averaged
_FLAT_GREY = 0.18  # share of pixels like their neighbours; 9 photographs at most 0.12
_CHEEK = 0.14  # of the distance of the eyes' outer corners
_ONE_SIDE, _TWO_HUES = 2.5, 1.6  # factors; of 5 photographs 1.0 to 1.15 and 1.0 to 1.25, of a patchy one 1.5 and 2.1
_DEVELOPED, _TOO_DARK = 1.4, 5.0  # factors of light
_PROFILE = 50.0  # degrees
# Between views: three of each of 10 drawn heads, landmarks off by 1 % of the eyes' distance, leave an error of 1.4 % of
# it in the depth of the nose's base at 0 degrees, 1.2 at 20, 1.0 at 40, 0.8 at 60.
_ONE_ANGLE = 20.0
_GRID = 40
_FOREHEAD = 0.7  # of the eyes' distance, from between the eyes; 45 faces in photographs and films have 1.3 at least
# In distances between the eyes' outer corners, from the highest brow: the forehead, and the step, thickness and
# greatest height of an edge over it. It strays from a parabola by at most 0.010 where 34 painted hats end, by 0.015 at
# least where 16 fringes do. Share of a forehead: of 48 without a hat at most 0.01 is cloth or hands.
_ACROSS, _OVER, _STEP, _THICK, _LOW, _STRAIGHT, _HATLESS = 0.3, (-0.05, 0.45), 0.01, 8, 0.25, 0.0125, 0.05
_COVERS = {
    "glasses": (0.12, "dark glasses hide"), "hand": (0.06, "a hand hides"), "cloth": (0.10, "cloth (a mask?) hides"),
}  # fmt: skip
_NO_COLORS = "no colours: the skin is grey, and what it hides of the eyes' colour too"
_PARTS = {"nose": slice(27, 36), "mouth": slice(48, 68)}


def picture_lines(found: PhotographLandmarks, insist: bool = False) -> list[str]:
    """What speaks against a photograph, for people to read; nothing where it shows one face well. With ``insist``
    nothing is refused."""
    face, name = found.face, found.photograph.name
    eyes = float((face.landmarks[36] - face.landmarks[45]).norm())
    hidden = _hidden_parts(found)
    refusals = []
    if eyes < _LEAST_EYES:
        refusals.append(f"{eyes:.0f} pixels between the outer corners of the eyes, expected at least {_LEAST_EYES:.0f}")
    if float(face.presence) < _PRESENT:
        refusals.append(f"hardly a face (likelihood {float(face.presence):.2f}), expected one of a person")
    across = face.landmarks[42:48].mean(0) - face.landmarks[36:42].mean(0)
    roll, confidence = math.degrees(math.atan2(across[1], across[0])), float(face.confidence.mean())
    if abs(roll) > _TILTED and confidence < _SURE_TILTED:
        refusals.append(
            f"a face upside down (roll angle {roll:.0f}°) with landmarks that are unsure (confidence "
            f"{confidence:.2f}), expected an upright face (0°), or a confidence of {_SURE_TILTED} at least"
        )
    if {"eyes", "mouth"} <= set(hidden):
        refusals.append(f"eyes and mouth hidden (visible to {hidden['eyes']:.0%} and {hidden['mouth']:.0%})")
    rivals = _rivals(found)
    if rivals and eyes < _FEW_EYES:
        places = ", ".join(f"{k} at ({x:.0f}, {y:.0f})" for k, (x, y, *_) in enumerate(found.boxes[:20].tolist()))
        refusals.append(
            f"{len(found.boxes)} faces, {rivals + 1} of them of similar size, the largest {float(face.box[2]):.0f} "
            f"pixels wide, expected one large face, or --face with the number of one of all ({places})"
        )
    if refusals and not insist:
        raise NoFaceError(f"{name}: found {'; '.join(refusals)}; give another photograph, or --insist to fit it anyway")
    lines = [f"found {refusal}" for refusal in refusals]
    if _LEAST_EYES <= eyes < _FEW_EYES:
        lines.append(
            f"{eyes:.0f} pixels between the eyes' outer corners, below {_FEW_EYES:.0f}: the head is a rough guess"
        )
    lines += [
        f"the {part} hidden (visible to {share:.0%}; sunglasses, a mask, a hand?): there the head is the model's guess"
        for part, share in hidden.items()
    ]
    if rivals and eyes >= _FEW_EYES:
        numbers = f"--face 1 to {rivals}" if rivals > 1 else "--face 1"
        lines.append(f"the largest of {len(found.boxes)} faces is taken, {rivals} more nearly as large ({numbers})")
    return [f"WARNING: {name}: {line}" for line in lines]


def _rivals(found: PhotographLandmarks) -> int:
    """How many other faces are so large that one of them may be meant; none where the user has said which."""
    areas = found.boxes[:, 2] * found.boxes[:, 3]
    return 0 if found.asked else int((areas > _RIVAL * areas[found.number]).sum()) - 1


def angle_lines(fit: ImageFit) -> list[str]:
    """Whether all photographs show a face from the side, or several from one angle, for people to read."""
    ahead = torch.stack([-camera.rotation[2] for camera in fit.cameras])  # towards the camera, as the head sees it
    turns = torch.rad2deg(torch.atan2(ahead[:, 0], ahead[:, 2]))
    low, high = float(turns.min()), float(turns.max())
    if bool((turns.abs() > _PROFILE).all()):
        listed = ", ".join(f"{turn:.0f}°" for turn in turns.tolist())
        return [f"WARNING: only profiles ({listed}): how wide the face is they do not show; add a view from the front"]
    # The least cosine is that of the two views which differ most, also in pitch.
    if len(turns) < 2 or float((ahead @ ahead.T).min()) < math.cos(math.radians(_ONE_ANGLE)):
        return []
    front = abs(low + high) / 2 < _ONE_ANGLE
    return [
        f"note: all {len(turns)} pictures show the face from about one angle (yaw angles {low:.0f}° to {high:.0f}°, "
        f"{high - low:.0f}° apart): how far nose, chin and brow stand out is the model's guess, as with one picture; "
        f"add a view turned by 45° to {'either' if front else 'the other'} side"
    ]


def edge_lines(photograph: Path, size: tuple[int, int], landmarks: Tensor) -> list[str]:
    """Whether a photograph's edge cuts off a face with landmarks (68,2), also beyond it, for people to read."""
    beyond = int(((landmarks < -0.5) | (landmarks > landmarks.new_tensor(size) - 0.5)).any(-1).sum())
    if not beyond:
        return []
    return [
        f"WARNING: {photograph.name}: the picture's edge cuts off the face ({beyond} of {len(landmarks)} landmarks lie "
        "beyond it): there the head is the model's guess; give a picture of the whole face"
    ]


def forehead_lines(photograph: Path, size: tuple[int, int], landmarks: Tensor) -> list[str]:
    """Whether a photograph's edge cuts off the forehead above landmarks (68,2), for people to read."""
    up, eyes = landmarks[27] - landmarks[8], (landmarks[36] - landmarks[45]).norm()
    hairline = landmarks[27] + _FOREHEAD * eyes * up / up.norm()
    if not bool(((hairline < -0.5) | (hairline > hairline.new_tensor(size) - 0.5)).any()):
        return []
    return [
        f"WARNING: {photograph.name}: the picture's edge cuts off the forehead: the head is bald if no "
        "picture shows hair; give a picture of the whole head"
    ]


def cover_lines(photograph: Path, parts: FaceParts, landmarks: Tensor, cut: bool = False) -> list[str]:
    """What stands before a face with landmarks (68,2), for people to read; nothing where nothing does.

    A picture's edge that cuts the face is no hand, for which the network takes it.
    """
    face = _inside(parts, landmarks)
    lines = []
    for name, (least, words) in _COVERS.items():
        if cut and name == "hand":
            continue
        share = float(parts.of(name)[face].mean())
        if share > least:
            lines.append(f"WARNING: {photograph.name}: {words} {share:.0%} of the face; its skin there is completed")
    return lines


def hat_lines(photograph: Path, parts: FaceParts, landmarks: Tensor) -> list[str]:
    """Whether a hat or a hand covers the forehead over landmarks (68,2), for people to read. A dark hat is hair to the
    network, but ends in a straight edge low over the brows."""
    marks = landmarks.double()
    eyes, middle = marks[45] - marks[36], (marks[36] + marks[45]) / 2
    up = torch.stack([eyes[1], -eyes[0]])
    brows = float(((marks[17:27] - middle) @ up / eyes.square().sum()).nan_to_num(-math.inf).amax())
    if not math.isfinite(brows):
        return []
    across = torch.linspace(-_ACROSS, _ACROSS, 25, dtype=torch.float64)
    high = torch.arange(*_OVER, _STEP, dtype=torch.float64)
    at = middle + across[:, None] * eyes + (brows + high)[:, None, None] * up
    share = float(parts.around(at[high > -3 * _OVER[0]], "cloth", "hand").mean())
    covered = (parts.around(at, "hair", "cloth") > _PRESENT).unfold(0, _THICK, 1).all(-1)
    edge = _OVER[0] + _STEP * covered.byte().argmax(0).double()
    bends = across[:, None] ** torch.arange(3)
    stray = edge - bends @ torch.linalg.lstsq(bends, edge[:, None]).solution[:, 0]
    straight = (
        bool(covered.any(0).all()) and float(edge.median()) < _LOW and float(stray.square().mean()) < _STRAIGHT**2
    )
    if share < _HATLESS and not straight:
        return []
    what = f"a hat or a hand hides the forehead (cloth or hand {share:.0%})" if share >= _HATLESS else (
        "what looks like hair ends in a straight edge over the brows: a hat, or an even fringe?")  # fmt: skip
    return [f"WARNING: {photograph.name}: {what}; its hair is not taken; give a picture without a hat"]


def without_hat(parts: FaceParts, landmarks: Tensor) -> FaceParts:
    """Parts of a photograph, of which what lies over the brows' landmarks (68,2) and is no skin counts as unseen."""
    brows = parts.in_crop(landmarks[17:27])[:, 1].nan_to_num(math.inf).amin()
    over = (torch.arange(parts.shares.shape[1]) < brows)[:, None]
    kept = torch.tensor([name in ("skin", "brows") for name in PARTS])[:, None, None]
    shares = parts.shares * (kept | ~over)
    shares[PARTS.index("background")] += 1 - shares.sum(0)
    return replace(parts, shares=shares)


def light_lines(photograph: Path, image: Tensor, parts: FaceParts, landmarks: Tensor) -> tuple[list[str], bool]:
    """What a photograph's light keeps from the skin's own colour, for people to read, nothing in good light; and
    whether it is too dark to show that colour: such a fit is poor."""
    lines, gain, needed = list[str](), exposure_gain(image, parts), needed_gain(image, parts)
    dark = needed > _TOO_DARK
    if dark:
        lines.append(
            f"WARNING: {photograph.name}: too dark: it shows 1/{needed:.0f} of the light of a well exposed "
            f"photograph, expected at least 1/{_TOO_DARK:.0f}; its light is multiplied by {gain:.1f} only, so the "
            f"painted skin is too dark; give a photograph in good light"
        )
    elif gain > _DEVELOPED:
        lines.append(
            f"note: {photograph.name}: taken for under-exposed, its light multiplied by {gain:.1f}, for what "
            f"should be white in it is grey; if the skin is too fair now, give a photograph in good light"
        )
    apart = _cheeks_apart(image, parts, landmarks)
    if apart is None:
        return lines, dark
    light, hue = math.exp(abs(float(apart.mean()))), math.exp(abs(float(apart[2] - apart[0])))
    if light >= _ONE_SIDE or hue >= _TWO_HUES:
        lines.append(
            f"WARNING: {photograph.name}: light from one side (cheeks differ by a factor of {light:.1f} in brightness, "
            f"{hue:.1f} in blue over red; in even light by less than 1.3): shadows are evened out and their detail is "
            f"lost; give one in even light"
        )
    return lines, dark


def _cheeks_apart(image: Tensor, parts: FaceParts, landmarks: Tensor) -> Tensor | None:
    """Logarithms of one cheek's light over the other's, (3,); None where one shows no skin."""
    marks = landmarks.double()
    reach = _CHEEK * (marks[45] - marks[36]).norm()
    side = reach * torch.linspace(-1, 1, _GRID, dtype=torch.float64)
    around = torch.cartesian_prod(side, side)
    cheeks = []
    for eye, corner in ((slice(36, 42), 48), (slice(42, 48), 54)):
        at = (marks[eye].mean(0) + marks[corner]) / 2 + around[around.norm(dim=1) < reach]
        at = at[parts.at(at, "skin").nan_to_num(0.0) > _PRESENT].round().long()
        at = at[((at >= 0) & (at < torch.tensor([image.shape[2], image.shape[1]]))).all(1)]
        if not len(at):
            return None
        cheeks.append(to_linear(image[:3, at[:, 1], at[:, 0]].double()).median(1).values.clamp(min=1e-3).log())
    return cheeks[0] - cheeks[1]


def _hidden_parts(found: PhotographLandmarks) -> dict[str, float]:
    """Parts of the face that something hides, and to what share they are visible."""
    face = found.face
    shares = {part: float(face.visibility[rows].mean()) for part, rows in _PARTS.items()}
    hidden = {part: share for part, share in shares.items() if share < _HIDDEN}
    eyes = (
        float(face.eye_visibility.mean()) if bool(face.iris.isfinite().any()) else float(face.visibility[36:48].mean())
    )
    return ({"eyes": eyes} if eyes < _EYE_HIDDEN else {}) | hidden


def grey_lines(photograph: Path, image: Tensor, parts: FaceParts, landmarks: Tensor) -> list[str]:
    """Whether the skin has no colours, for people to read."""
    skin = _skin(image, parts, landmarks.double())
    grey = skin.shape[1] >= _FEWEST and _is_grey(skin)
    return [f"WARNING: {photograph.name}: {_NO_COLORS}"] if grey else []


def _skin(image: Tensor, parts: FaceParts, marks: Tensor) -> Tensor:
    """The colours of a face's skin, (3,P)."""
    face = _inside(parts, marks)
    crop = parts.crop(image).double()
    return crop[:, face & (parts.of("skin") > _SURE)]


def _is_grey(skin: Tensor) -> bool:
    return float((skin.amax(0) - skin.amin(0)).mean()) < GREY


def color_lines(photograph: Path, image: Tensor, parts: FaceParts, landmarks: Tensor) -> list[str]:
    """What colours and grain of the skin say against a photograph of a person, for people to read."""
    marks = landmarks.double()
    skin = _skin(image, parts, marks)
    if skin.shape[1] < _FEWEST:
        return []
    if _is_grey(skin):
        lines = [_NO_COLORS]
        flat = _flat_share(image, marks)
        if flat > _FLAT_GREY:
            lines.insert(0, f"{flat:.0%} of the face without grain, which photographs have: a drawing, a statue?")
    else:
        lines = [*_hue_lines(skin), *_filter_lines(image, parts)]
    steps = _steps(image, marks)
    if len(steps) >= _FEWEST:
        usual, strong = steps.quantile(steps.new_tensor([0.5, 0.95])).tolist()
        if strong > _LEAST_STEP and usual < _PAINTED * strong:
            lines.append(
                f"a face of even patches with edges between them (from pixel to pixel it mostly differs by "
                f"{usual / strong:.1%} of its edges, photographs by 15% at least): a painting, a drawing, "
                f"a rendered head, a strong filter or denoising?"
            )
    return [f"WARNING: {photograph.name}: {line}" for line in lines]


def _hue_lines(skin: Tensor) -> list[str]:
    """What colours (3,P) of skin say against a photograph of a person in white light."""
    red, green, blue = skin.clamp(min=0.02).log()
    hue, light = torch.stack([red - green, blue - green], dim=1), (red + green + blue) / 3
    lines = []
    powers = torch.stack([torch.ones_like(light), light, light.square()], dim=1)
    apart = hue - powers @ torch.linalg.lstsq(powers, hue).solution  # what brightness does not explain
    least = float(torch.linalg.eigvalsh(apart.T.cov())[0].clamp(min=0).sqrt())
    if least < _ONE_HUE:
        lines.append(
            f"skin of one hue (it varies by {least:.1%}, that of people by {_BLOTCHES:.1%} at least): a rendered head, "
            f"a statue, a mask, a toned or smoothed picture?"
        )
    cast = hue.median(0).values
    green_cast, red_cast = float(cast.mean()), float(cast[1] - cast[0])
    if not (_GREEN_CAST[0] < green_cast < _GREEN_CAST[1] and _RED_CAST[0] < red_cast < _RED_CAST[1]):
        red_share, blue_share = cast.exp().tolist()
        lines.append(
            f"colours that skin has not in white light (red {red_share:.2f} and blue {blue_share:.2f} of green): "
            f"a filter, coloured light, paint?"
        )
    return lines


def _filter_lines(image: Tensor, parts: FaceParts) -> list[str]:
    """What colours of eyes' whites and of hair say of a filter, for people to read."""
    crop = parts.crop(image).double()
    eyes, hair = (crop[:, share] for share in (parts.of("eyes") > _PRESENT, parts.of("hair", "brows") > _HAIR))
    lines = []
    if eyes.shape[1] >= _FEW_WHITES:
        light = eyes.mean(0)
        _, green, blue = eyes[:, light >= light.quantile(_WHITES)].median(1).values.clamp(min=0.02).tolist()
        if math.log(blue / green) > _VIOLET_WHITES:
            lines.append(
                f"whites of eyes that are violet or blue (blue {blue / green:.2f} of green): a filter, such light?"
            )
    if hair.shape[1] >= _FEW_HAIRS:
        light = hair.mean(0)
        red, green, _ = hair[:, light <= light.quantile(_DARK_HAIR)].mean(1).clamp(min=0.02).tolist()
        if math.log(red / green) < _TEAL_HAIR:
            lines.append(f"dark hair that is greenish (red {red / green:.2f} of green): a filter, such light, a dye?")
    return lines


def _steps(image: Tensor, marks: Tensor) -> Tensor:
    """By how much a face with landmarks (68,2) differs from pixel to pixel, to the right or downward, (P,)."""
    known = marks[marks.isfinite().all(-1)]
    low, high = known.amin(0).floor().long().clamp(min=0), known.amax(0).ceil().long().clamp(min=0)
    scale = max(1, round(float((high - low).max()) / _FINEST))
    piece = image[:3, low[1] : high[1], low[0] : high[0]].mean(0, keepdim=True)
    if min(piece.shape[1:]) < 2 * scale:
        return piece.new_zeros(0)
    light = avg_pool2d(piece[None], scale)[0, 0]
    face = _outlined((known - low) / scale - 0.5 + 0.5 / scale, light.shape)
    right, down = light.diff(dim=1)[:-1].abs(), light.diff(dim=0)[:, :-1].abs()
    return torch.maximum(right, down)[face[:-1, :-1] & face[1:, :-1] & face[:-1, 1:]]


def _flat_share(image: Tensor, marks: Tensor) -> float:
    """The share of pixels like their neighbours in the middle of a face with landmarks (68,2)."""
    known = marks[marks.isfinite().all(-1)]
    low, high = known.amin(0), known.amax(0)
    (left, top), (right, bottom) = ((low + share * (high - low)).long().clamp(min=0).tolist() for share in (0.25, 0.75))
    light = image[:3, top:bottom, left:right].mean(0)
    if min(light.shape) < 4:
        return 0.0
    alike = [(light.diff(dim=axis).abs() < 1 / 255) for axis in (0, 1)]
    return float((alike[0][:, 1:] & alike[1][1:]).float().mean())


def _inside(parts: FaceParts, landmarks: Tensor) -> Tensor:
    """The pixels of the parts' crop within a face with landmarks (68,2), NaN for missing; (S,S) bool."""
    known = landmarks[landmarks.isfinite().all(-1)]
    return _outlined(parts.in_crop(known), parts.shares.shape[1:])


def _outlined(points: Tensor, shape: Sequence[int]) -> Tensor:
    """The pixels (H,W) bool within the hull of points (P,2)."""
    outline = cv2.convexHull(points.round().int().numpy())
    return torch.from_numpy(cv2.fillConvexPoly(np.zeros(tuple(shape), np.uint8), outline, 1)).bool()

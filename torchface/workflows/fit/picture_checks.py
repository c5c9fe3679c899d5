"""Checks of what photographs show: a face that is large, uncovered, alone, in colour, not drawn and not filtered."""

import math
from pathlib import Path

import cv2
import torch
from torch import Tensor

from torchface.color_space import to_linear
from torchface.landmarks import NoFaceError
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.modeling import ImageFit
from torchface.modeling.photographs.image_texture import GREY
from torchface.modeling.photographs.skin_light import exposure_gain
from torchface.workflows.fit.fit_landmarks import PhotographLandmarks

# Pixels between the outer corners of the eyes: a face 40 pixels wide has 20.
_LEAST_EYES, _FEW_EYES = 10.0, 30.0
_PRESENT = 0.5
_HIDDEN, _EYE_HIDDEN = 0.4, 0.3  # visibilities; those of 9 faces that nothing hides were above 0.87 and 0.91
_RIVAL = 0.5  # of the chosen face's area: another that large may be the one that is meant
_RED, _BLUE = (
    (0.03, 1.0),
    (-1.1, 0.1),
)  # logarithms of red and blue over green of skin; 8 faces 0.20 to 0.51, -0.53 to -0.08
_ONE_HUE = 0.02  # of red over green, its logarithm's middle 80 %; 19 photographs 0.11 to 0.76, clay 0.008
_FLAT, _FLAT_GREY = 0.65, 0.18  # share of pixels like their neighbours; 9 photographs at most 0.12
_CHEEK = 0.14  # of the distance of the eyes' outer corners
_ONE_SIDE, _TWO_HUES = 2.5, 1.6  # factors; of 5 photographs 1.0 to 1.15 and 1.0 to 1.25, of a patchy one 1.5 and 2.1
_DEVELOPED = 1.4  # a factor of light
_PROFILE = 50.0  # degrees
_GRID = 40
_COVERS = {
    "glasses": (0.12, "dark glasses hide"), "hand": (0.06, "a hand hides"), "cloth": (0.10, "cloth (a mask?) hides"),
}  # fmt: skip
_PARTS = {"nose": slice(27, 36), "mouth": slice(48, 68)}


def picture_lines(found: PhotographLandmarks, image: Tensor, insist: bool = False) -> list[str]:
    """What speaks against a photograph, for people to read; nothing where it shows one face well.

    Args:
        image: the photograph, (3,H,W) in [0,1].
        insist: report also what is refused otherwise.
    """
    face, name = found.face, found.photograph.name
    eyes = float((face.landmarks[36] - face.landmarks[45]).norm())
    hidden = _hidden_parts(found)
    refusals = []
    if eyes < _LEAST_EYES:
        refusals.append(f"{eyes:.0f} pixels between the outer corners of the eyes, expected at least {_LEAST_EYES:.0f}")
    if float(face.presence) < _PRESENT:
        refusals.append(f"hardly a face (likelihood {float(face.presence):.2f}), expected one of a person")
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
    return [f"WARNING: {name}: {line}" for line in [*lines, *_color_lines(image, face.box)]]


def _rivals(found: PhotographLandmarks) -> int:
    """How many other faces are so large that one of them may be meant; none where the user has said which."""
    areas = found.boxes[:, 2] * found.boxes[:, 3]
    return 0 if found.asked else int((areas > _RIVAL * areas[found.number]).sum()) - 1


def profile_lines(fit: ImageFit) -> list[str]:
    """Whether all photographs show a face from the side, for people to read."""
    turns = [
        float(torch.rad2deg(torch.atan2(-camera.rotation[2, 0], -camera.rotation[2, 2]))) for camera in fit.cameras
    ]
    if all(abs(turn) > _PROFILE for turn in turns):
        listed = ", ".join(f"{turn:.0f}°" for turn in turns)
        return [f"WARNING: only profiles ({listed}): how wide the face is they do not show; add a view from the front"]
    return []


def cover_lines(photograph: Path, parts: FaceParts, landmarks: Tensor) -> list[str]:
    """What stands before a face, for people to read; nothing where nothing does.

    Args:
        parts: what it shows.
        landmarks: of the face, (68,2) pixels; NaN for missing.
    """
    known = landmarks[landmarks.isfinite().all(-1)]
    outline = torch.from_numpy(cv2.convexHull(known.float().numpy())[:, 0]).double()
    low, high = outline.amin(0), outline.amax(0)
    steps = torch.linspace(0, 1, _GRID, dtype=torch.float64)
    grid = torch.cartesian_prod(*(low[k] + (high[k] - low[k]) * steps for k in (0, 1)))
    edge = torch.roll(outline, -1, 0) - outline
    aside = edge[:, 0] * (grid[:, None, 1] - outline[:, 1]) - edge[:, 1] * (grid[:, None, 0] - outline[:, 0])
    inside = grid[(aside >= 0).all(1) | (aside <= 0).all(1)]
    lines = []
    for name, (least, words) in _COVERS.items():
        share = float(parts.at(inside, name).nanmean())
        if share > least:
            lines.append(f"WARNING: {photograph.name}: {words} {share:.0%} of the face; its skin there is completed")
    return lines


def light_lines(photograph: Path, image: Tensor, parts: FaceParts, landmarks: Tensor) -> list[str]:
    """What a photograph's light keeps from the skin's own colour, for people to read; nothing in good light.

    Args:
        image: the photograph, (3,H,W) in [0,1].
        parts: what it shows.
        landmarks: of the face, (68,2) pixels; NaN for missing.
    """
    lines, gain = list[str](), exposure_gain(image, parts)
    if gain > _DEVELOPED:
        lines.append(
            f"note: {photograph.name}: taken for under-exposed, its light multiplied by {gain:.1f}, for what "
            f"should be white in it is grey; if the skin is too fair now, give a photograph in good light"
        )
    apart = _cheeks_apart(image, parts, landmarks)
    if apart is None:
        return lines
    light, hue = math.exp(abs(float(apart.mean()))), math.exp(abs(float(apart[2] - apart[0])))
    if light < _ONE_SIDE and hue < _TWO_HUES:
        return lines
    return [
        *lines,
        f"WARNING: {photograph.name}: light from one side (cheeks differ by a factor of {light:.1f} in brightness, "
        f"{hue:.1f} in blue over red; in even light by less than 1.3): shadows are evened out and their detail is "
        f"lost; give one in even light",
    ]


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


def _color_lines(image: Tensor, box: Tensor) -> list[str]:
    """What colours and grain of the face's middle say against a photograph of skin."""
    middle = _middle(image, box)
    if min(middle.shape[1:]) < 4:
        return []
    grey = float((middle.amax(0) - middle.amin(0)).mean()) < GREY
    light = middle.mean(0)
    alike = [(light.diff(dim=axis).abs() < 1 / 255) for axis in (0, 1)]
    flat = float((alike[0][:, 1:] & alike[1][1:]).float().mean())
    lines = []
    if flat > (_FLAT_GREY if grey else _FLAT):
        what = "a drawing, a statue" if grey else "a drawing, a strong filter"
        lines.append(f"{flat:.0%} of the face without grain, which photographs have: {what}? It may be nobody's head")
    if grey:
        return [*lines, "no colours: the skin is grey, and what it hides of the eyes' colour too"]
    ratio = (middle[0].clamp(min=0.02) / middle[1].clamp(min=0.02)).log().flatten()
    low, high = ratio.quantile(ratio.new_tensor([0.1, 0.9])).tolist()
    if high - low < _ONE_HUE:
        lines.append(
            f"one hue all over (red over green differs by {high - low:.1%}): a toned picture, a statue, a mask?"
        )
    red, green, blue = middle.flatten(1).median(dim=1).values.clamp(min=0.02).log().tolist()
    if not (_RED[0] < red - green < _RED[1] and _BLUE[0] < blue - green < _BLUE[1]):
        lines.append(
            f"colours that skin has not (red {math.exp(red - green):.2f} and blue {math.exp(blue - green):.2f} of "
            f"green): a filter, coloured light, paint?"
        )
    return lines


def _middle(image: Tensor, box: Tensor) -> Tensor:
    """The middle quarter of a face's box (4,) in an image (3,H,W)."""
    x, y, width, height = box.tolist()
    low = (max(int(y + height / 4), 0), max(int(x + width / 4), 0))
    return image[:3, low[0] : int(y + 3 * height / 4), low[1] : int(x + 3 * width / 4)]

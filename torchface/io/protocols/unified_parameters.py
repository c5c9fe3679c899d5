"""Avatar parameters of Unified Expressions, as VRCFaceTracking has them: sums of expressions and their reverse."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import UNIFIED

_SIDES = ("Left", "Right")
FULL_GAZE = math.radians(45.0)  # what VRCFaceTracking counts as 1

_MEANS = (
    *("BrowInnerUp", "BrowOuterUp", "CheekSquint", "EyeClosed", "LipFunnel", "LipFunnelLower", "LipFunnelUpper"),
    *("LipPucker", "LipPuckerLower", "LipPuckerUpper", "LipSuckLower", "LipSuckUpper", "MouthDimple"),
    *("MouthLowerDown", "MouthPress", "MouthStretch", "MouthUpperUp", "NoseSneer"),
)
"""Parameters that are the mean of all expressions whose names begin so and end in parts and sides."""

_PARTS = ("", "Upper", "Lower")


def _combined() -> dict[str, dict[str, float]]:
    """Parameters that are sums of several expressions; ``1`` is a constant."""
    sums: dict[str, dict[str, float]] = {
        "JawX": {"JawRight": 1, "JawLeft": -1},
        "JawZ": {"JawForward": 1, "JawBackward": -1},
        "MouthUpperX": {"MouthUpperRight": 1, "MouthUpperLeft": -1},
        "MouthLowerX": {"MouthLowerRight": 1, "MouthLowerLeft": -1},
        "MouthX": {"MouthUpperRight": 0.5, "MouthLowerRight": 0.5, "MouthUpperLeft": -0.5, "MouthLowerLeft": -0.5},
    }
    for stem in _MEANS:
        terms = [f"{stem}{part}{side}" for part in _PARTS for side in _SIDES]
        terms = [term for term in terms if term in UNIFIED.names]
        sums[stem] = {term: 1 / len(terms) for term in terms}
    for side in _SIDES:
        smile = {f"MouthCornerPull{side}": 0.8, f"MouthCornerSlant{side}": 0.2}
        lower = {f"BrowLowerer{side}": 0.75, f"BrowPinch{side}": 0.25}
        sums |= {
            f"EyeOpen{side}": {"1": 1, f"EyeClosed{side}": -1},
            f"EyeLid{side}": {"1": 0.75, f"EyeClosed{side}": -0.75, f"EyeWide{side}": 0.25},
            f"BrowUp{side}": {f"BrowOuterUp{side}": 0.6, f"BrowInnerUp{side}": 0.4},
            f"BrowDown{side}": lower,
            f"BrowExpression{side}": {f"BrowInnerUp{side}": 0.5, f"BrowOuterUp{side}": 0.5}
            | {name: -share for name, share in lower.items()},
            f"CheekPuffSuck{side}": {f"CheekPuff{side}": 1, f"CheekSuck{side}": -1},
            f"LipPucker{side}": {f"LipPuckerUpper{side}": 0.5, f"LipPuckerLower{side}": 0.5},
            f"LipSuckFunnelUpper{side}": {f"LipSuckUpper{side}": 1, f"LipFunnelUpper{side}": -1},
            f"LipSuckFunnelLower{side}": {f"LipSuckLower{side}": 1, f"LipFunnelLower{side}": -1},
            f"MouthTightenerStretch{side}": {f"MouthTightener{side}": 1, f"MouthStretch{side}": -1},
            f"MouthCornerY{side}": {f"MouthCornerSlant{side}": 1, f"MouthFrown{side}": -1},
            f"MouthSmile{side}": smile,
            f"MouthSad{side}": {f"MouthFrown{side}": 1},
            f"SmileFrown{side}": smile | {f"MouthFrown{side}": -1},
            f"SmileSad{side}": smile | {f"MouthFrown{side}": -1},
        }
    for stem in (
        *("EyeOpen", "EyeLid", "BrowUp", "BrowDown", "BrowExpression", "CheekPuffSuck", "SmileFrown", "SmileSad"),
        *("LipSuckFunnelUpper", "LipSuckFunnelLower", "MouthTightenerStretch", "MouthCornerY"),
    ):
        both = [sums[stem + side] for side in _SIDES]
        sums[stem] = {name: sum(terms.get(name, 0.0) for terms in both) / 2 for name in {**both[0], **both[1]}}
    lips = ("MouthUpperUpLeft", "MouthUpperUpRight", "MouthLowerDownLeft", "MouthLowerDownRight")
    sums["MouthOpen"] = dict.fromkeys(lips, 0.25)
    return sums


COMBINED: Mapping[str, Mapping[str, float]] = _combined()
"""Sums by their terms. Source: docs.vrcft.io, VRCFaceTracking Parameters. ``SmileSad`` counts the frown alone."""

ACTIVE = ("EyeTrackingActive", "ExpressionTrackingActive", "LipTrackingActive")
"""Parameters that say whether something is tracked."""

LARGER = {name: (f"{name}Left", f"{name}Right") for name in ("EyeWide", "EyeSquint")}
"""Parameters that are the larger one of two expressions."""

_GAZE: dict[str, dict[str, float]] = {
    "EyeLeftX": {"EyeLookInLeft": 1, "EyeLookOutLeft": -1},
    "EyeRightX": {"EyeLookOutRight": 1, "EyeLookInRight": -1},
    **{f"Eye{side}Y": {f"EyeLookUp{side}": 1, f"EyeLookDown{side}": -1} for side in _SIDES},
    "EyeX": {"EyeLookInLeft": 0.5, "EyeLookOutRight": 0.5, "EyeLookOutLeft": -0.5, "EyeLookInRight": -0.5},
    "EyeY": {f"EyeLook{way}{side}": sign for way, sign in (("Up", 0.5), ("Down", -0.5)) for side in _SIDES},
}
_ANGLES: dict[str, tuple[tuple[int, float], ...]] = {
    **{f"Eye{side}X": ((ROTATIONS.index(f"{side}EyeYaw"), FULL_GAZE),) for side in _SIDES},
    **{f"Eye{side}Y": ((ROTATIONS.index(f"{side}EyePitch"), -FULL_GAZE),) for side in _SIDES},
}
_ANGLES |= {f"Eye{axis}": _ANGLES[f"EyeLeft{axis}"] + _ANGLES[f"EyeRight{axis}"] for axis in "XY"}


def _reversed_terms() -> dict[str, tuple[float, list[tuple[int, float]]]]:
    """Of each parameter its value at rest, and of each of its expressions the row and the factor of the difference from
    that; those of the most expressions first, of as many those of both sides."""
    rows = {name: row for row, name in enumerate(UNIFIED.names)}
    terms: dict[str, Mapping[str, float]] = {**COMBINED, **_GAZE}
    terms |= {name: dict.fromkeys(sides, 0.5) for name, sides in LARGER.items()}
    terms["EyesSquint"], terms["EyesClosedAmount"] = terms["EyeSquint"], terms["EyeClosed"]
    found = dict[str, tuple[float, list[tuple[int, float]]]]()
    for name in sorted(terms, key=lambda name: (-len(terms[name].keys() - {"1"}), "Left" in name or "Right" in name)):
        shares = {term: share for term, share in terms[name].items() if term != "1"}
        of_sign = {sign: sum(share for share in shares.values() if share * sign > 0) for sign in (1, -1)}
        factors = [(rows[term], 1 / of_sign[1 if share > 0 else -1]) for term, share in shares.items()]
        found[name] = terms[name].get("1", 0.0), factors
    return found | {name: (0.0, [(row, 1.0)]) for name, row in rows.items()}


_REVERSED = _reversed_terms()
_RANKS = {name: rank for rank, name in enumerate(_REVERSED, 1)}


class UnifiedFace:
    """Expressions and turns of the eyes that parameters stand for, whichever of them a sender has.

    A sum says of its expressions that those of one sign are equal and those of the other are zero. A parameter of
    fewer expressions counts more than one of more.

    Example:
        >>> face = UnifiedFace()
        >>> face.take("EyeLidLeft", 0.25), face.take("TongueX", 1.0)
        (True, False)
        >>> from torchface.shape_names import ARKIT
        >>> round(face.arkit()[ARKIT.index("eyeBlinkLeft")].item(), 4)
        0.6667
    """

    def __init__(self) -> None:
        self.rotations = torch.zeros(len(ROTATIONS))  # Live Link Face's nine, radians
        self._values = [0.0] * len(UNIFIED.names)  # a list, whose numbers are set much faster than those of a tensor
        self._ranks = [0] * len(UNIFIED.names)  # of what they came from; 0 until they are known
        self._angle_ranks = [0] * len(ROTATIONS)

    def take(self, name: str, value: float) -> bool:
        """Takes a parameter (without ``v2/``); False of one that moves nothing of ARKit's."""
        if name not in _REVERSED or name in UNIFIED.others:
            return False
        (rest, factors), rank = _REVERSED[name], _RANKS[name]
        for row, factor in factors:
            if rank >= self._ranks[row]:
                self._ranks[row] = rank
                self._values[row] = max((value - rest) * factor, 0.0)
        for row, factor in _ANGLES.get(name, ()):
            if rank >= self._angle_ranks[row]:
                self._angle_ranks[row] = rank
                self.rotations[row] = value * factor
        return True

    def arkit(self) -> Tensor:
        """ARKit's weights (52,): of several twins the mean of those that are known."""
        values, known = UNIFIED.to_arkit(torch.tensor([self._values, [float(rank > 0) for rank in self._ranks]]))
        return torch.where(known > 0, values / known, 0.0)

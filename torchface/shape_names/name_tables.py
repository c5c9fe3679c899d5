"""Tables from ARKit's names to Unified Expressions, VRM's clips, Oculus' visemes and MetaHuman's curves, and back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchface.shape_names.arkit_names import ARKIT

_SIDES = ("Left", "Right")
_COMES_BACK = 0.99
_NOTHING = 1e-6  # of a factor
_RIDGE = 1e-5  # without it a clip without a pose has no weight of its own


@dataclass(frozen=True, eq=False)
class TwinTable:
    """Names that each have one of ARKit's as their twin; one of ARKit's may have several.

    Args:
        twins: for each of ARKit's names those that it drives; together they give it their mean.
        others: names that ARKit has nothing for.

    Example:
        >>> table = TwinTable({"cheekPuff": ("CheekPuffLeft", "CheekPuffRight")})
        >>> table.to_arkit(torch.tensor([0.25, 0.75]))[ARKIT.index("cheekPuff")].item()
        0.5
        >>> table.lost_here()
        ('CheekPuffLeft', 'CheekPuffRight')
    """

    twins: Mapping[str, tuple[str, ...]]
    others: tuple[str, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All names, in ARKit's order, then the others."""
        return (*(name for arkit in ARKIT for name in self.twins.get(arkit, ())), *self.others)

    @cached_property
    def _copies(self) -> Tensor:
        row = {name: i for i, name in enumerate(self.names)}
        matrix = torch.zeros(len(self.names), len(ARKIT))
        for arkit, twins in self.twins.items():
            matrix[[row[name] for name in twins], ARKIT.index(arkit)] = 1.0
        return matrix

    def from_arkit(self, weights: Tensor) -> Tensor:
        """ARKit's weights (...,52) by these names (...,N); 0 for those that ARKit has nothing for."""
        return weights @ self._copies.to(weights).T

    def to_arkit(self, weights: Tensor) -> Tensor:
        """Weights (...,N) as ARKit's (...,52); 0 for those that these names lack."""
        copies = self._copies.to(weights)
        return weights @ (copies / copies.sum(0).clamp(min=1))

    def lost(self) -> tuple[str, ...]:
        """ARKit's names whose weight does not come back from here."""
        return _changed(ARKIT, self.to_arkit(self.from_arkit(torch.eye(len(ARKIT)))))

    def lost_here(self) -> tuple[str, ...]:
        """These names whose weight does not come back from ARKit."""
        return _changed(self.names, self.from_arkit(self.to_arkit(torch.eye(len(self.names)))))


@dataclass(frozen=True, eq=False)
class ClipTable:
    """Names of clips, each of which is a pose of several of ARKit's shapes.

    From ARKit's weights come those clips, 0 to 1, that together are nearest to them: a face that is one clip gives that
    clip alone.

    Args:
        poses: for each clip ARKit's weights; a clip without any is the face at rest and has what the others leave of 1.
        both: a clip that is two others at once: it takes what the two have in common.

    Example:
        >>> clips = VRM0.from_arkit(VRM0.to_arkit(torch.eye(len(VRM0.names))))
        >>> torch.allclose(clips, torch.eye(len(VRM0.names)), atol=0.01)
        True
    """

    poses: Mapping[str, Mapping[str, float]]
    both: Mapping[str, tuple[str, str]]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """All names."""
        return tuple(self.poses)

    @cached_property
    def _matrix(self) -> Tensor:
        matrix = torch.zeros(len(self.names), len(ARKIT))
        for row, pose in enumerate(self.poses.values()):
            for name, weight in pose.items():
                matrix[row, [i for i, arkit in enumerate(ARKIT) if arkit in (name, *(name + s for s in _SIDES))]] = (
                    weight
                )
        return matrix

    @cached_property
    def _solved(self) -> list[int]:
        return [row for row, name in enumerate(self.names) if self.poses[name] and name not in self.both]

    @cached_property
    def _hessian(self) -> Tensor:
        poses = self._matrix[self._solved].double()
        return poses @ poses.T + _RIDGE * torch.eye(len(poses), dtype=torch.float64)

    def to_arkit(self, weights: Tensor) -> Tensor:
        """Weights of clips (...,N) as ARKit's (...,52), at most 1."""
        return (weights @ self._matrix.to(weights)).clamp(max=1.0)

    def from_arkit(self, weights: Tensor) -> Tensor:
        """Clips (...,N) that are nearest to ARKit's weights (...,52)."""
        from torchface.optim import box_qp  # names alone need no solver

        rows, flat = self._solved, weights.detach().cpu().double().reshape(-1, len(ARKIT))
        clips = flat.new_zeros(len(flat), len(self.names))
        solved = box_qp(self._hessian, -flat @ self._matrix[rows].double().T)
        clips[:, rows] = solved
        index = self.names.index
        for whole, (left, right) in self.both.items():
            common = torch.minimum(clips[:, index(left)], clips[:, index(right)])
            clips[:, index(left)] -= common
            clips[:, index(right)] -= common
            clips[:, index(whole)] = common
        for row, name in enumerate(self.names):
            if not self.poses[name]:
                clips[:, row] = (1 - clips.sum(1)).clamp(min=0)
        return clips.reshape(*weights.shape[:-1], -1).to(weights)

    def factors(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """What each of some clips takes of ARKit's weights so that they alone are nearest to these, before limits."""
        nearest = torch.linalg.pinv(self._matrix[[self.names.index(name) for name in names]].double())
        rows = nearest.abs() > _NOTHING
        return {
            name: {ARKIT[row]: float(nearest[row, column]) for row in rows[:, column].nonzero()[:, 0].tolist()}
            for column, name in enumerate(names)
        }

    def lost(self) -> tuple[str, ...]:
        """ARKit's names whose weight does not come back from here."""
        return _changed(ARKIT, self.to_arkit(self.from_arkit(torch.eye(len(ARKIT)))))

    def lost_here(self) -> tuple[str, ...]:
        """These names whose weight does not come back from ARKit."""
        return _changed(self.names, self.from_arkit(self.to_arkit(torch.eye(len(self.names)))))

    def renamed(self, names: Mapping[str, str]) -> "ClipTable":
        """The same clips by other names."""
        both = {names[whole]: (names[left], names[right]) for whole, (left, right) in self.both.items()}
        return ClipTable({names[name]: pose for name, pose in self.poses.items()}, both)


def _changed(names: tuple[str, ...], back: Tensor) -> tuple[str, ...]:
    return tuple(name for name, weight in zip(names, back.diagonal().tolist(), strict=True) if weight < _COMES_BACK)


def _sided(*pairs: tuple[str, str]) -> dict[str, tuple[str, ...]]:
    """Twins of both sides of pairs; several twins are divided by blanks."""
    return {arkit + side: tuple(name + side for name in names.split()) for arkit, names in pairs for side in _SIDES}


def _spread(arkit: str, *names: str) -> dict[str, tuple[str, ...]]:
    """Twins of one of ARKit's shapes that are divided into sides."""
    return {arkit: tuple(name + side for name in names for side in _SIDES)}


UNIFIED = TwinTable(
    {
        **_sided(("eyeBlink", "EyeClosed"), ("eyeLookDown", "EyeLookDown"), ("eyeLookIn", "EyeLookIn")),
        **_sided(("eyeLookOut", "EyeLookOut"), ("eyeLookUp", "EyeLookUp"), ("eyeSquint", "EyeSquint")),
        **_sided(("eyeWide", "EyeWide"), ("browDown", "BrowLowerer BrowPinch"), ("browOuterUp", "BrowOuterUp")),
        **_sided(("cheekSquint", "CheekSquint"), ("noseSneer", "NoseSneer"), ("mouthFrown", "MouthFrown")),
        **_sided(("mouthSmile", "MouthCornerPull MouthCornerSlant"), ("mouthDimple", "MouthDimple")),
        **_sided(("mouthStretch", "MouthStretch"), ("mouthPress", "MouthPress"), ("mouthLowerDown", "MouthLowerDown")),
        **_sided(("mouthUpperUp", "MouthUpperUp MouthUpperDeepen"), ("jaw", "Jaw")),
        **_spread("browInnerUp", "BrowInnerUp"),
        **_spread("cheekPuff", "CheekPuff"),
        **_spread("mouthFunnel", "LipFunnelUpper", "LipFunnelLower"),
        **_spread("mouthPucker", "LipPuckerUpper", "LipPuckerLower"),
        **_spread("mouthRollUpper", "LipSuckUpper"),
        **_spread("mouthRollLower", "LipSuckLower"),
        **{f"mouth{side}": (f"MouthUpper{side}", f"MouthLower{side}") for side in _SIDES},
        "jawForward": ("JawForward",),
        "jawOpen": ("JawOpen",),
        "mouthClose": ("MouthClosed",),
        "mouthShrugUpper": ("MouthRaiserUpper",),
        "mouthShrugLower": ("MouthRaiserLower",),
        "tongueOut": ("TongueOut",),
    },
    (
        *(
            name + side
            for name in ("EyeDilation", "EyeConstrict", "NasalDilation", "NasalConstrict")
            for side in _SIDES
        ),
        *(name + side for name in ("CheekSuck", "LipSuckCorner", "MouthTightener") for side in _SIDES),
        *("JawBackward", "JawClench", "JawMandibleRaise", "TongueUp", "TongueDown", "TongueRight", "TongueLeft"),
        *("TongueRoll", "TongueBendDown", "TongueCurlUp", "TongueSquish", "TongueFlat", "TongueTwistRight"),
        *("TongueTwistLeft", "SoftPalateClose", "ThroatSwallow", "NeckFlexRight", "NeckFlexLeft"),
    ),
)
"""Unified Expressions, the standard of VRCFaceTracking. Source: docs.vrcft.io, Tracking Standard Comparison."""


def _curves(arkit: str, *names: str) -> dict[str, tuple[str, ...]]:
    """MetaHuman's curves; a name that ends in ``*`` stands for left and right, ``+`` for the quarters of the lips."""
    ends = {"*": ("L", "R"), "+": ("UL", "UR", "DL", "DR")}
    return {arkit: tuple(f"CTRL_expressions_{n.rstrip('*+')}{end}" for n in names for end in ends.get(n[-1], ("",)))}


def _sided_curves(*pairs: tuple[str, str]) -> dict[str, tuple[str, ...]]:
    return {
        key: twins
        for arkit, names in pairs
        for side in _SIDES
        for key, twins in _curves(arkit + side, *(f"{name}{side[0]}" for name in names.split())).items()
    }


METAHUMAN = TwinTable(
    {
        **_sided_curves(("eyeBlink", "eyeBlink"), ("eyeLookDown", "eyeLookDown"), ("eyeLookUp", "eyeLookUp")),
        **_sided_curves(("eyeSquint", "eyeSquintInner"), ("eyeWide", "eyeWiden"), ("cheekSquint", "eyeCheekRaise")),
        **_sided_curves(("browDown", "browDown browLateral"), ("browOuterUp", "browRaiseOuter")),
        **_sided_curves(("noseSneer", "noseWrinkle noseWrinkleUpper"), ("mouthSmile", "mouthCornerPull")),
        **_sided_curves(("mouthFrown", "mouthCornerDepress"), ("mouthDimple", "mouthDimple")),
        **_sided_curves(("mouthStretch", "mouthStretch"), ("mouthPress", "mouthPressU mouthPressD")),
        **_sided_curves(("mouthLowerDown", "mouthLowerLipDepress"), ("mouthUpperUp", "mouthUpperLipRaise")),
        # In an eye's name the direction comes before the side: the left eye looks in to the right.
        **_curves("eyeLookInLeft", "eyeLookRightL"),
        **_curves("eyeLookInRight", "eyeLookLeftR"),
        **_curves("eyeLookOutLeft", "eyeLookLeftL"),
        **_curves("eyeLookOutRight", "eyeLookRightR"),
        **_curves("browInnerUp", "browRaiseIn*"),
        **_curves("cheekPuff", "mouthCheekBlow*", "mouthLipsBlow*"),
        **_curves("jawForward", "jawFwd"),
        **{name: _curves(name, name)[name] for name in ("jawLeft", "jawRight", "jawOpen", "mouthLeft", "mouthRight")},
        **_curves("mouthClose", "mouthLipsTogether+"),
        **_curves("mouthFunnel", "mouthFunnel+"),
        **_curves("mouthPucker", "mouthLipsPurse+"),
        **_curves("mouthRollLower", "mouthLowerLipRollIn*"),
        **_curves("mouthRollUpper", "mouthUpperLipRollIn*"),
        **_curves("mouthShrugLower", "jawChinRaiseD*"),
        **_curves("mouthShrugUpper", "jawChinRaiseU*"),
        **_curves("tongueOut", "tongueOut"),
    }
)
"""Curves of MetaHuman's control rig that Epic's pose asset drives from ARKit's; the asset's poses have Live Link's
names, which :func:`mapping` knows. Epic's asset weights some curves otherwise than 1."""

VRM0 = ClipTable(
    {
        "A": {"jawOpen": 0.7},
        "I": {"mouthStretch": 0.6, "jawOpen": 0.1},
        "U": {"mouthPucker": 0.9, "jawOpen": 0.1},
        "E": {"jawOpen": 0.35, "mouthStretch": 0.3, "mouthLowerDown": 0.4},
        "O": {"mouthFunnel": 0.7, "jawOpen": 0.35},
        "Blink": {"eyeBlink": 1.0},
        "Blink_L": {"eyeBlinkLeft": 1.0},
        "Blink_R": {"eyeBlinkRight": 1.0},
        "Joy": {"mouthSmile": 0.9, "cheekSquint": 0.5},
        "Angry": {"browDown": 0.9, "noseSneer": 0.4},
        "Sorrow": {"mouthFrown": 0.8, "browInnerUp": 0.6},
        "Fun": {"mouthDimple": 0.7, "eyeSquint": 0.6},
        "Surprised": {"eyeWide": 0.8, "browOuterUp": 0.8, "browInnerUp": 0.5},
    },
    {"Blink": ("Blink_L", "Blink_R")},
)
"""Clips of VRM 0, and ``Surprised``, which most avatars have. What each is in ARKit's weights is our choice: VRM names
them and leaves them to the artist. ``LookUp`` and the like are left out: eyes turn."""

VRM1 = VRM0.renamed(
    dict(
        zip(
            VRM0.names,
            (
                *("aa", "ih", "ou", "ee", "oh", "blink", "blinkLeft", "blinkRight"),
                *("happy", "angry", "sad", "relaxed", "surprised"),
            ),
            strict=True,
        )
    )
)
"""The same clips by VRM 1's names."""

VISEMES = ClipTable(
    {
        "sil": {},
        "PP": {"mouthPress": 0.6, "mouthRollUpper": 0.3},
        "FF": {"mouthRollLower": 0.6, "mouthUpperUp": 0.3},
        "TH": {"tongueOut": 0.4, "jawOpen": 0.15},
        "DD": {"mouthUpperUp": 0.2, "mouthLowerDown": 0.3, "jawOpen": 0.15},
        "kk": {"mouthUpperUp": 0.3, "jawOpen": 0.25},
        "CH": {"mouthFunnel": 0.5, "mouthShrugUpper": 0.4},
        "SS": {"mouthStretch": 0.4, "mouthLowerDown": 0.4, "mouthShrugLower": 0.2},
        "nn": {"mouthLowerDown": 0.3, "jawOpen": 0.1, "mouthShrugLower": 0.4},
        "RR": {"mouthFunnel": 0.3, "mouthPucker": 0.3, "jawOpen": 0.1},
        "aa": {"jawOpen": 0.7},
        "E": {"jawOpen": 0.35, "mouthStretch": 0.4, "mouthDimple": 0.3},
        "I": {"mouthStretch": 0.6, "mouthSmile": 0.3, "jawOpen": 0.1},
        "O": {"mouthFunnel": 0.6, "jawOpen": 0.4},
        "U": {"mouthPucker": 0.9, "jawOpen": 0.1},
    },
    {},
)
"""Oculus' 15 visemes, named as Meta's Viseme Reference does; what each is in ARKit's weights is our choice."""

"""Looks of someone beside the shape of the head: skin, hair, brows, beard, make-up, glasses, clothes."""

from dataclasses import dataclass

import torch
from torch import Tensor

from .backdrops import uniform
from .portrait_geometry import Hairdo

_TONES = torch.tensor([[0.93, 0.77, 0.69], [0.87, 0.67, 0.56], [0.76, 0.55, 0.42], [0.58, 0.39, 0.28],
                       [0.40, 0.26, 0.19], [0.24, 0.155, 0.115]])  # fmt: skip
_HAIR = torch.tensor([[0.05, 0.04, 0.04], [0.13, 0.09, 0.07], [0.24, 0.16, 0.11], [0.42, 0.29, 0.18],
                      [0.66, 0.52, 0.34], [0.55, 0.53, 0.51], [0.82, 0.81, 0.79], [0.45, 0.18, 0.09]])  # fmt: skip
_IRIS = torch.tensor(
    [[0.16, 0.09, 0.05], [0.30, 0.19, 0.10], [0.35, 0.33, 0.18], [0.30, 0.42, 0.50], [0.42, 0.50, 0.52]]
)


@dataclass(frozen=True, eq=False)
class Looks:
    """One person's looks; colours are sRGB (3,), shares and strengths lie in [0,1]."""

    skin: Tensor
    lips: Tensor
    hair: Tensor
    iris: Tensor
    clothes: Tensor
    redness: float
    freckles: float
    shadows: float
    wrinkles: float
    gloss: float  # how much light the skin mirrors
    # Share of hair in the brows, their thickness and their arch beside the usual, and millimetres that they lie higher.
    brow: tuple[float, float, float, float]
    beard: float  # share of hair, as the next two
    moustache: float
    stubble: float
    liner: float  # make-up round the eyes, as the next
    shadow: float
    shadow_color: Tensor
    lashes: bool  # dark ones, or none that show
    hairdo: Hairdo
    hat: Tensor | None  # the colour of a cap instead of hair
    # Half their width and height, millimetres, grey and thickness (pixels) of the frame, how dark the lenses are.
    glasses: tuple[float, float, float, float, float] | None
    seed: int


def draw_looks(generator: torch.Generator) -> Looks:
    """Someone's looks: as many dark as light skins, beards for some, make-up for others."""

    def chance(share: float) -> bool:
        return uniform(0, 1, generator) < share

    def between(low: float, high: float) -> float:
        return uniform(low, high, generator)

    def color() -> Tensor:
        grey, vivid = between(0.04, 0.92), between(0, 1) ** 2
        return (grey + vivid * (torch.rand(3, generator=generator) - 0.5)).clamp(0.02, 0.95)

    tone = between(0, len(_TONES) - 1.001)
    skin = torch.lerp(_TONES[int(tone)], _TONES[int(tone) + 1], tone - int(tone))
    skin = skin * (1 + 0.06 * torch.randn(3, generator=generator) * torch.tensor([0.5, 0.7, 1.0]))
    dark_skin = tone > 3
    choices = [0, 0, 1, 1, 2] if dark_skin else [0, 1, 1, 2, 2, 3, 3, 4, 5, 6, 7]
    hair = _HAIR[choices[int(between(0, len(choices) - 1e-3))]] * between(0.75, 1.25)
    iris = _IRIS[int(between(0, 2))] if dark_skin else _IRIS[int(between(0, len(_IRIS) - 1e-3))]
    made_up = chance(0.3)
    # Many lips hardly differ from the skin about them.
    lips = skin * torch.lerp(torch.ones(3), torch.tensor([0.86, 0.66, 0.68]), between(0.15, 1)) * between(0.85, 1.08)
    if made_up and chance(0.7):
        red = torch.tensor([between(0.35, 0.85), between(0.05, 0.3), between(0.1, 0.4)])
        lips = torch.lerp(lips, red, between(0.3, 0.95))
    bearded = not made_up and chance(0.42)
    hat = chance(0.07)
    bald = not hat and chance(0.12)
    hairdo = Hairdo(
        between(4, 14) if hat else (0.0 if bald else between(1, 26)),
        between(-26, -12) if chance(0.22) and not bald else between(-8, 18),
        between(20, 220) if chance(0.45) and not bald else 0.0,
        between(42, 85),
    )
    glasses = None
    if chance(0.2):
        lens = between(0.55, 0.97) if chance(0.12) else between(0.0, 0.12)
        glasses = (between(18, 30), between(12, 23), between(0.0, 0.45), between(0.7, 3.2), lens)
    return Looks(
        skin.clamp(0.03, 0.97), lips.clamp(0.02, 0.95), hair.clamp(0.01, 0.95), iris, color(),
        between(0, 1), between(0.3, 1) if chance(0.2) else 0.0, between(0, 1), between(0, 1) ** 2,
        between(0.01, 0.16) if chance(0.8) else between(0.16, 0.4),
        (between(0.2, 1.0) if chance(0.88) else 0.08, between(0.45, 1.7), between(0.2, 1.4), between(-3.5, 2.5)),
        between(0.3, 1.0) if bearded and chance(0.5) else 0.0,
        between(0.3, 1.0) if bearded and chance(0.6) else 0.0,
        between(0.1, 0.6) if bearded else 0.0,
        between(0.3, 1.0) if made_up else 0.0, between(0.1, 0.8) if made_up and chance(0.6) else 0.0, color() * 0.7,
        chance(0.75 if made_up else 0.35), hairdo, color() if hat else None, glasses, int(between(0, 1e6)),
    )  # fmt: skip

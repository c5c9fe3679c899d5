"""A light in words, as bright on a face as the film's."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from torchface.errors import ValueRangeError
from torchface.rendering.point_light import PointLight

_AMBIENT = 0.3  # unless said
_MOST = 100.0


@dataclass(frozen=True)
class WantedLight:
    """A light from one direction and from everywhere, beside the film's."""

    azimuth: float = 0.0  # degrees from the camera to the viewer's right
    elevation: float = 0.0  # degrees upwards
    # of both together; with 1 a face is as bright in the mean as in the film, and with a source behind it as bright as
    # with one beside it, less what is lost there
    strength: float = 1.0
    ambient: float = _AMBIENT  # the share from everywhere
    # red, green, blue: its colour beside the film's
    red: float = 1.0
    green: float = 1.0
    blue: float = 1.0

    @staticmethod
    def parse(words: Sequence[str]) -> "WantedLight":
        """Of words such as ``azimuth=60``."""
        bounds = {"azimuth": (-360, 360), "elevation": (-90, 90), "ambient": (0, 1)}
        names = tuple(WantedLight.__dataclass_fields__)
        found: dict[str, float] = {}
        for word in words:
            name, _, number = word.partition("=")
            try:
                value = float(number)
            except ValueError:
                value = math.nan
            low, high = bounds.get(name, (0, _MOST))
            if name not in names or not low <= value <= high:
                raise ValueRangeError(
                    f"--light: found {word!r:.60}, expected NAME=NUMBER with {', '.join(names)}; azimuth and elevation "
                    f"in degrees, ambient of 0 to 1, the others of 0 to {_MOST:g}"
                )
            found[name] = value
        return WantedLight(**found)

    def beside(self, film: PointLight) -> PointLight:
        """The light, in the film's brightness and colour."""
        around, up = math.radians(self.azimuth), math.radians(self.elevation)
        toward = torch.tensor([math.sin(around) * math.cos(up), -math.sin(up), -math.cos(around) * math.cos(up)])
        ambient = torch.full((3,), self.ambient)
        plain = PointLight.directional(ambient, 1 - ambient, toward)
        color = torch.tensor([self.red, self.green, self.blue]) * self.strength
        whole = film.on_front() * color / plain.on_front(least=0.0)
        return replace(plain, ambient=ambient * whole, intensity=(1 - ambient) * whole)

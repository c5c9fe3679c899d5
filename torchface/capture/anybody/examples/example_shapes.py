"""Landmarks of a neutral face and of example expressions, by name; and the file that holds them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.files.documents import read_json, write_json

EYE_CORNERS = (36, 45)
"""The outer corners of the eyes: their distance is the unit of errors."""

_FORMAT = "torchface.examples/1"
_MOST = 512
_MAX_BYTES = 2**22
_DECIMALS = 4


def is_examples(path: str | Path) -> bool:
    """Whether a JSON file says that it holds examples."""
    document = read_json(path, max_bytes=_MAX_BYTES)
    return isinstance(document.found, dict) and document.found.get("format") == _FORMAT


@dataclass(frozen=True, eq=False)
class ExampleShapes:
    """Where the 68 landmarks lie on one face at rest and in N expressions.

    All as pictures of one size show them, the face seen from the front: x to the picture's right, y down. ``left`` in
    a name is the person's left, the picture's right where it is not mirrored.

    Args:
        names: of the N expressions, none twice.
        neutral: iBUG's 68, (68,2), pixels.
        landmarks: in the order of ``names``, (N,68,2), pixels.

    Raises:
        NameMismatchError: not one name each, or a name twice.
        ShapeError: not (68,2) and (N,68,2), or no expression at all.
        ValueRangeError: a landmark is NaN or infinite, or the neutral's eyes or its box have no size.

    Source: realtime_facial_animation 5.1.

    Example:
        >>> from torchface.capture.anybody import paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> examples.save("me.json")
        >>> ExampleShapes.load("me.json").names == examples.names
        True
    """

    names: tuple[str, ...]
    neutral: Tensor
    landmarks: Tensor

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        if self.neutral.shape != (68, 2) or self.landmarks.ndim != 3 or self.landmarks.shape[1:] != (68, 2):
            raise ShapeError(
                f"examples: found neutral {tuple(self.neutral.shape)} and landmarks {tuple(self.landmarks.shape)}, "
                "expected (68,2) and (N,68,2)"
            )
        if not 1 <= len(self.landmarks) <= _MOST:
            raise ShapeError(f"examples: found {len(self.landmarks)} expressions, expected 1 to {_MOST}")
        if len(self.names) != len(self.landmarks):
            raise NameMismatchError(
                f"examples: found {len(self.names)} names for {len(self.landmarks)} expressions, expected one each"
            )
        if len(set(self.names)) < len(self.names):
            twice = sorted({name for name in self.names if self.names.count(name) > 1})
            raise NameMismatchError(f"examples: found {', '.join(map(repr, twice[:5]))} more than once")
        finite = torch.isfinite(self.landmarks).flatten(1).all(1)
        if not bool(finite.all()) or not bool(torch.isfinite(self.neutral).all()):
            bad = [name for name, good in zip(self.names, finite.tolist(), strict=True) if not good] or ["neutral"]
            raise ValueRangeError(f"examples: NaN or infinite landmarks in {', '.join(bad[:5])}; expected pixels")
        size = self.neutral.amax(0) - self.neutral.amin(0)
        if not float(size.min()) > 1e-3 * float(size.max()) or not self.eyes_distance > 1e-3 * float(size.max()):
            raise ValueRangeError(
                f"examples: found a neutral face of {float(size[0]):.3g} x {float(size[1]):.3g} pixels whose eyes' "
                f"outer corners are {self.eyes_distance:.3g} apart, expected a face seen from the front"
            )

    @property
    def eyes_distance(self) -> float:
        """Between the outer corners of the neutral's eyes, pixels."""
        return float((self.neutral[EYE_CORNERS[0]] - self.neutral[EYE_CORNERS[1]]).norm())

    @property
    def basis(self) -> Tensor:
        """What each expression adds to the neutral, (68,2,N)."""
        return (self.landmarks - self.neutral).permute(1, 2, 0).contiguous()

    def select(self, names: Sequence[str]) -> "ExampleShapes":
        """These expressions alone, in this order, whatever order the examples are in.

        Raises:
            NameMismatchError: some are not there.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            raise NameMismatchError(
                f"examples: found no {', '.join(map(repr, missing[:5]))}{' and others' if len(missing) > 5 else ''} "
                f"among {len(self.names)} expressions ({', '.join(self.names[:5])}, ...)"
            )
        return ExampleShapes(tuple(names), self.neutral, self.landmarks[[self.names.index(name) for name in names]])

    def save(self, path: str | Path) -> None:
        """Writes them as JSON, ten-thousandths of a pixel kept."""

        def rows(values: Tensor) -> object:
            return [[round(float(one), _DECIMALS) for one in point] for point in values.detach().cpu().double()]

        write_json(
            path,
            {
                "format": _FORMAT,
                "names": list(self.names),
                "neutral": rows(self.neutral),
                "landmarks": [rows(shape) for shape in self.landmarks],
            },
            indent=None,
        )

    @staticmethod
    def load(path: str | Path) -> "ExampleShapes":
        """Reads what :meth:`save` wrote.

        Raises:
            FileFormatError: the file is missing, too large, no such JSON, or its values are of other types or counts.
            NameMismatchError, ShapeError, ValueRangeError: they make no examples; the message names the file.
        """
        document = read_json(path, _FORMAT, _MAX_BYTES)
        document.table("format", "names", "neutral", "landmarks")
        names = document["names"].texts("a list of names")
        document["landmarks"].rows(1, _MOST, f"a list of 1 to {_MOST} expressions")
        neutral = document["neutral"].tensor(68, 2, dtype=torch.float32)
        landmarks = document["landmarks"].tensor(None, 68, 2, dtype=torch.float32)
        try:
            return ExampleShapes(names, neutral, landmarks)
        except (NameMismatchError, ShapeError, ValueRangeError) as error:
            raise type(error)(f"{path}: {error}") from error

"""Faces in photographs as dlib's XML holds them: image files, boxes, landmarks by number."""

from dataclasses import dataclass
from pathlib import Path
from xml.parsers import expat

import torch
from torch import Tensor

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file

_MAX_BYTES = 64 * 2**20
_MAX_PARTS = 1000
_MAX_FACES = 100_000
_MAX_ROWS = 10_000_000
_MAX_COORDINATE = 1e6
_MAX_DEPTH = 32


@dataclass(frozen=True, eq=False)
class LabelledFace:
    """One face in a photograph."""

    image: str  # the photograph's file as the XML names it, relative to the XML
    box: Tensor  # left, top, width, height, (4,) pixels
    # Landmarks by their number, (L,2), pixels, x right, y down, pixel centres at integers from 0; NaN for numbers that
    # are left out.
    points: Tensor


def load_dlib_faces(path: str | Path) -> list[LabelledFace]:
    """Reads dlib's XML of labelled faces, as imglab writes it.

    Nothing outside the file is opened; a file that declares entities is refused.

    Returns:
        The faces in the file's order; those without landmarks have points (0,2). Boxes marked to be ignored are left
        out.
    """
    path = Path(path)
    reader = _Reader(path)
    parser = expat.ParserCreate()
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.EntityDeclHandler = reader.entity
    parser.ExternalEntityRefHandler = reader.entity
    try:
        parser.Parse(read_file(path, _MAX_BYTES), True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        raise FileFormatError(f"{path}: not readable XML ({error})") from error
    if not reader.is_dataset:
        raise FileFormatError(f"{path}: found no <dataset> with <images>, expected dlib's XML")
    return reader.faces


class _Reader:
    """Collects faces while the parser goes through the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.faces: list[LabelledFace] = []
        self.is_dataset = False
        self._image: str | None = None
        self._box: Tensor | None = None
        self._ignored = False
        self._rows = self._depth = 0
        self._parts: dict[int, tuple[float, float]] = {}

    def entity(self, *_: object) -> int:
        raise FileFormatError(f"{self.path}: found an XML entity declared, expected none")

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise FileFormatError(f"{self.path}: found tags nested more than {_MAX_DEPTH} deep, expected dlib's XML")
        if tag == "dataset":
            self.is_dataset = True
        elif tag == "image":
            if self._image is not None:
                raise FileFormatError(f"{self.path}: found an <image> inside another, expected each to end before")
            self._image = self._text(attributes, "file", tag)
        elif tag == "box":
            if self._image is None or self._box is not None:
                raise FileFormatError(f"{self.path}: found a <box> outside an <image>, expected each inside one")
            names = ("left", "top", "width", "height")
            self._box = torch.tensor([self._number(attributes, name, tag) for name in names], dtype=torch.float64)
            self._ignored = attributes.get("ignore", "0") not in ("0", "")
            self._parts = {}
        elif tag == "part":
            if self._box is None:
                raise FileFormatError(f"{self.path}: found a <part> outside a <box>, expected each inside one")
            name = self._text(attributes, "name", tag)
            if not (name.isascii() and name.isdigit() and len(name) < 10 and int(name) < _MAX_PARTS):
                raise FileFormatError(f"{self.path}: found a part named {name!r:.40}, expected 0 to {_MAX_PARTS - 1}")
            if int(name) in self._parts:
                raise FileFormatError(f"{self.path}: found part {name} twice in a face of {self._image}, expected once")
            self._parts[int(name)] = self._number(attributes, "x", tag), self._number(attributes, "y", tag)

    def end(self, tag: str) -> None:
        self._depth -= 1
        if tag == "image":
            self._image = None
        elif tag == "box" and self._box is not None:
            count = max(self._parts, default=-1) + 1
            self._rows += count
            if len(self.faces) >= _MAX_FACES or self._rows > _MAX_ROWS:
                raise FileFormatError(
                    f"{self.path}: found more than {_MAX_FACES} faces or {_MAX_ROWS} landmarks, expected fewer"
                )
            points = torch.full((count, 2), torch.nan, dtype=torch.float64)
            if self._parts:
                points[list(self._parts)] = torch.tensor(list(self._parts.values()), dtype=torch.float64)
            if not self._ignored:
                assert self._image is not None
                self.faces.append(LabelledFace(self._image, self._box, points))
            self._box = None

    def _text(self, attributes: dict[str, str], name: str, tag: str) -> str:
        if name not in attributes:
            raise FileFormatError(f"{self.path}: found a <{tag}> without {name}, expected it")
        return attributes[name]

    def _number(self, attributes: dict[str, str], name: str, tag: str) -> float:
        text = self._text(attributes, name, tag)
        try:
            number = float(text)
        except ValueError:
            number = float("nan")
        if not abs(number) <= _MAX_COORDINATE:
            raise FileFormatError(f"{self.path}: found {name}={text!r:.40} in a <{tag}>, expected a number of pixels")
        return number

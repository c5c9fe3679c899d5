"""The character of the page: a ``.glb``, and what drives each of its shapes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from torchface.capture.retargeting import ShapeMap, ShapeRule, load_shape_rules, shape_map
from torchface.correctives.activation import CorrectiveActivation
from torchface.errors import FileFormatError, NameMismatchError
from torchface.files.whole_files import read_file
from torchface.geometry.meshes.normal_maps import SurfaceMaps
from torchface.io import load_rig, save_rig
from torchface.io.gltf.corrective_extras import scene_correctives
from torchface.io.gltf.gltf_document import Document, document_of
from torchface.io.gltf.primitive_reading import moving_target_names, read_target_names
from torchface.io.scenes.missing_shapes import no_shapes, no_target
from torchface.io.tables.csv_table import quoted
from torchface.io.vrm.vrm_expressions import vrm_expressions
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, RecognisedShape, arkit_name, recognised_shapes, spelled_as, vowel_sources
from torchface.synthetic import character
from torchface.workflows.cached_graph import cached_file

LARGEST_CHARACTER = 100 * 2**20
"""Bytes; what the page itself takes (``export/web/src/character_check.js``)."""

_FEW = 10
_BLOCK = 4096  # frames mapped at a time
_GLB = (".glb", ".vrm")


@dataclass(frozen=True, eq=False)
class Character:
    """A ``.glb`` and what drives it.

    Args:
        name: for people.
        data: the file; its meshes and pictures may be compressed.
        shapes: from ARKit's names to the file's.
        correctives: follows these where the file has some.
    """

    name: str
    data: bytes
    shapes: ShapeMap
    correctives: CorrectiveActivation | None = None

    @cached_property
    def document(self) -> Document:
        """The file as glTF."""
        return document_of(Path(self.name), self.data)

    @property
    def names(self) -> tuple[str, ...]:
        """Of its shapes, without correctives."""
        return self.shapes.to_names

    @property
    def still(self) -> tuple[str, ...]:
        """Its shapes that move nothing."""
        meshes = range(len(self.document.objects("meshes")))
        moving = frozenset[str]().union(*(moving_target_names(self.document, i) for i in meshes))
        return tuple(name for name in self.names if name not in moving)

    def targets(self, weights: Tensor) -> tuple[tuple[str, ...], Tensor]:
        """Names and weights (T,N+C) of all morph targets for weights (T,N) of the shapes."""
        if self.correctives is None:
            return self.names, weights
        followers = tuple(definition.name for definition in self.correctives.definitions)
        return (*self.names, *followers), torch.cat([weights, self.correctives(weights)], 1)

    def weights(self, arkit: Tensor) -> Tensor:
        """ARKit's weights (T,52) as the character's (T,N)."""
        moved = torch.empty(len(arkit), len(self.names))
        for first in range(0, len(arkit), _BLOCK):  # an hour at once would fill the memory
            rows = slice(first, first + _BLOCK)
            moved[rows] = self.shapes(arkit[rows])
        return moved

    def renamed(self, meanings: Mapping[str, str]) -> "Character":
        """With other meanings of shapes: ARKit's name, or none for one that stays still, by the shape's name."""
        shapes, products = self.shapes, list(self.shapes.products)
        matrix, limits = shapes.matrix.clone(), [getattr(shapes, name).clone() for name in ("gain", "lower", "upper")]
        for name, arkit in meanings.items():
            if name in self.names and arkit in ("", *ARKIT):
                row = self.names.index(name)
                matrix[row], products[row] = 0, ()
                for limit, value in zip(limits, (1.0, 0.0, 1.0), strict=True):
                    limit[row] = value
                if arkit:
                    matrix[row, ARKIT.index(arkit)] = 1
        return replace(self, shapes=ShapeMap(ARKIT, self.names, matrix, tuple(products), *limits))

    def notes(self) -> tuple[str, ...]:
        """What the user should know of it."""
        driven = len(self.names) - len(self.shapes.undriven)
        if driven >= _FEW or not self.shapes.undriven:
            return ()
        return (
            f"{self.name}: {driven} of its {len(self.names)} shapes move; {quoted(self.shapes.undriven)} are "
            "neither ARKit's nor in a mapping table (--mapping)",
        )

    def page_table(self) -> bytes:
        """What drives each shape, as JSON for the page: rows of ``ARKIT`` and their factors, or a rule, by its name."""
        sources: dict[str, Any] = {name: self._drive(row) for row, name in enumerate(self.names)}
        if self.correctives is not None:
            knots = iter(self.correctives.knots.tolist())
            for one in self.correctives.definitions:
                sources[one.name] = {"drivers": one.drivers, "knots": next(knots) if one.is_in_between else None}
        return json.dumps({"name": self.name, "sources": sources}).encode()

    def _drive(self, row: int) -> Any:
        shapes = self.shapes
        used = [[column, float(shapes.matrix[row, column])] for column in shapes.matrix[row].nonzero()[:, 0].tolist()]
        limits = [float(values[row]) for values in (shapes.gain, shapes.lower, shapes.upper)]
        plain = all(0 <= factor <= 1 for _, factor in used)
        if not shapes.products[row] and limits == [1.0, 0.0, 1.0] and plain:
            return used
        gain, lower, upper = limits
        return {"sum": used, "product": list(shapes.products[row]), "gain": gain, "lower": lower, "upper": upper}


def load_character(path: str | Path | None = None, table: Path | None = None, progress: Progress = silent) -> Character:
    """Reads a ``.glb`` or ``.vrm`` as it is, or what else holds a rig, or the embedded performer.

    A table (``load_shape_rules``) is for shapes of other names than ARKit's.
    """
    whole = path is not None and Path(path).suffix.lower() in _GLB
    name = "the embedded performer" if path is None else Path(path).name if whole else f"{Path(path).stem}.glb"
    data = _taken(Path(path)) if whole and path is not None else _written(path, progress)
    document = document_of(Path(path or name), data)
    definitions = scene_correctives(document)
    names = _shapes(document, {definition.name for definition in definitions})
    rules = _recognised(names, document) if table is None else load_shape_rules(table)
    activation = CorrectiveActivation(definitions, names) if definitions else None
    try:
        return Character(name, data, shape_map(ARKIT, names, rules), activation)
    except NameMismatchError as error:
        if table is not None:
            raise NameMismatchError(f"{table}: {error}") from error
        raise NameMismatchError(
            f"{path}: found the shapes {quoted(names)}, none by a name of ARKit's; expected names that ARKit knows, "
            "such as jawOpen, or --mapping FILE, a TOML table that says what drives each of them, such as\n"
            f'["{names[0]}"]\nsum = {{jawOpen = 1.0}}'
        ) from error


def _shapes(document: Document, followers: set[str]) -> tuple[str, ...]:
    """The names of all meshes' morph targets, each once, but for correctives."""
    meshes = [read_target_names(document, i) for i in range(len(document.objects("meshes")))]
    names = tuple(dict.fromkeys(name for mesh in meshes for name in mesh if name not in followers))
    if not names:
        raise no_shapes(document.path, no_target(len(meshes)))
    return names


def _recognised(names: Sequence[str], document: Document) -> dict[str, ShapeRule]:
    """Rules for shapes that other programs call otherwise, such as ``A25_Jaw_Open`` or ``Fcl_EYE_Close_L``, or that a
    VRM's expressions name."""
    found = recognised_shapes(names)
    said = _by_expressions(document, found)
    rules = {
        name: ShapeRule({arkit: 1.0})
        for arkit, shape in found.items()
        for name in shape.names
        if spelled_as(name, ARKIT) is None
    }
    if "jawOpen" not in found and not any("jawOpen" in sums for sums in said.values()):  # the mouth opens by vowels
        rules |= {name: ShapeRule(sources) for name in names if (sources := vowel_sources(name))}
    return rules | {name: ShapeRule(sums) for name, sums in said.items()}


def _by_expressions(document: Document, found: Mapping[str, RecognisedShape]) -> dict[str, dict[str, float]]:
    """What a VRM's expressions take of ARKit's weights for targets by other names than those ``found``."""
    meshes = [read_target_names(document, i) for i in range(len(document.objects("meshes")))]
    known = {name for shape in found.values() for name in shape.names}
    sums: dict[str, dict[str, float]] = {}
    try:
        expressions = vrm_expressions(document)
    except FileFormatError:
        if not found:
            raise
        return sums  # a character that moves without them need not have them in order
    for expression, binds in expressions.items():
        arkit = arkit_name(expression)
        if arkit is None or arkit not in ARKIT or arkit in found:
            continue
        for bind in binds:
            for name in read_target_names(document, bind.mesh)[bind.target : bind.target + 1]:
                if name not in known and {i for i, row in enumerate(meshes) if name in row} <= {b.mesh for b in binds}:
                    sums.setdefault(name, {})[arkit] = bind.weight
    return sums


def _taken(path: Path) -> bytes:
    if path.is_file() and path.stat().st_size > LARGEST_CHARACTER:
        raise FileFormatError(
            f"{path}: found {path.stat().st_size / 2**20:.0f} MB, expected at most {LARGEST_CHARACTER / 2**20:.0f} MB "
            "for a character that moves live: export it with smaller textures, or the head alone"
        )
    return read_file(path)


def _written(path: str | Path | None, progress: Progress) -> bytes:
    def embedded() -> bytes:
        progress("making the character, once; ten seconds on a quiet machine")
        shown = character()
        return _saved(shown.rig, shown.surface)

    if path is None:
        return cached_file("character", ".glb", embedded, ("synthetic/head", "io/gltf"))
    return _saved(load_rig(path))


def _saved(rig: BlendshapeRig, surface: SurfaceMaps | None = None) -> bytes:
    with TemporaryDirectory() as folder:
        save_rig(rig, Path(folder) / "character.glb", surface)
        return read_file(Path(folder) / "character.glb", LARGEST_CHARACTER)

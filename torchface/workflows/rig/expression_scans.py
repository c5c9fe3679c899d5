"""Expression scans: which file of a folder shows what, whether it shows its side, and what it has not shown."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.errors import AlignmentError, FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.files.whole_files import visible_files
from torchface.geometry.meshes.operators import edges, vertex_normals
from torchface.io.tables.csv_table import TableReader
from torchface.mesh import Mesh
from torchface.optim.sparse import SparseCholesky
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping, mirror
from torchface.workflows.batch.batch_items import SCAN_ENDINGS

WEIGHTS = "weights.csv"
NEUTRAL = "neutral"
LAYOUT = (
    f"a {WEIGHTS} with the header scan,<shape>,... and a row for each file, or files named for what they show: "
    "jawOpen.obj, jawOpen=0.6+mouthSmileLeft=0.5.obj"
)

_SEVERAL = 3
# Millimetres between an expression and its mirror image where the two are distinguished at all.
_TELLING = 1.0
_LEAST_VERTICES = 20
# Of the way from the middle between the two: 1 is what was asked for, -1 its mirror image; a weak expression is near 0.
# Mirrored scans of another performer's smile, brow and jaw come to -0.5 to -0.8, right ones to 0.9 and more.
_CLEARLY_OTHER = -0.35
# Of its distance from the face at rest, what an example is off what it is named for. Right examples of another
# performer, up to 1.4 times as strong, come to at most 0.3; a jaw named brow, another head, a face at rest to 1.
_UNSHOWN = 0.97
_DATA_WEIGHT = 10.0
_DAMPING = 0.03


@dataclass(frozen=True, eq=False)
class Expression:
    """A scan and roughly what it shows: weights (N,) of a rig's shapes, in [0,1]."""

    path: Path
    weights: Tensor

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.path.stem


def weights_row(weights: dict[str, float], names: Sequence[str], where: str) -> Tensor:
    """Weights (N,) of a rig's shapes from some of them by name, in any spelling that ``shape_names`` reads."""
    given = tuple(weights)
    matrix = mapping(given, names)
    unknown = [name for name, used in zip(given, matrix.any(0).tolist(), strict=True) if not used]
    if unknown:
        raise NameMismatchError(
            f"{where}: found {', '.join(map(repr, unknown[:5]))}, expected shapes of the template such as "
            f"{', '.join(names[:5])}"
        )
    outside = [f"{name}={value:g}" for name, value in weights.items() if not 0 <= value <= 1]
    if outside:
        raise ValueRangeError(f"{where}: found {', '.join(outside[:5])}, expected weights from 0 to 1")
    return matrix @ torch.tensor([float(weights[name]) for name in given])


def expressions_in(folder: Path, names: Sequence[str]) -> list[Expression]:
    """The expression scans of a folder, in the order of ``weights.csv``, or sorted by name.

    Without ``weights.csv`` each file's name gives what it shows: shapes joined by ``+``, each with ``=WEIGHT`` where
    that is not 1. A file named ``neutral`` is left out.
    """
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: found no such folder, expected one with scans: {LAYOUT}")
    table = folder / WEIGHTS
    expressions = _by_table(table, names) if table.is_file() else _by_name(folder, names)
    for expression in expressions:
        if not expression.weights.any():
            raise ValueRangeError(f"{expression.path}: found no weight above 0 for it, expected an expression")
    return expressions


def shared_notes(expressions: Sequence[Expression], shown: Tensor, names: Sequence[str]) -> list[str]:
    """A note where all of several scans show more of a shape than the neutral is said to, weights (N,): so may it."""
    if len(expressions) < _SEVERAL:
        return []
    least = torch.stack([expression.weights for expression in expressions]).amin(0)
    shared = " ".join(f"{names[i]}={float(least[i]):g}" for i in (least > shown).nonzero()[:, 0].tolist())
    return [f"every example shows {shared}; --pose {shared} where the neutral scan shows it, too"] if shared else []


def neutral_in(folder: Path) -> Path | None:
    """The folder's scan of the face at rest: the file named ``neutral``, where there is one."""
    return next((path for path in _scans(folder) if path.stem.lower() == NEUTRAL), None)


def _scans(folder: Path) -> list[Path]:
    return [path for path in visible_files(folder, SCAN_ENDINGS) if path.is_file()]


def _by_table(table: Path, names: Sequence[str]) -> list[Expression]:
    reader = TableReader(table)
    reader.require(["scan"])
    rows = reader.read(["scan"], lambda cells: not any(cell.strip() for cell in cells))
    shapes = rows.names
    files = list(rows.texts["scan"])
    twice = sorted({file for file in files if files.count(file) > 1})
    if twice:
        raise FileFormatError(f"{table}: found more than one row for {', '.join(twice[:5])}, expected one a scan")
    expressions = []
    for number, file in enumerate(files):
        path = table.parent / file
        if Path(file).name != file or not path.is_file():
            raise FileFormatError(f"{table}: found {file!r} in the column scan, expected a file of the same folder")
        values = torch.from_numpy(rows.numbers[number]).nan_to_num().tolist()
        given = {shape: value for shape, value in zip(shapes, values, strict=True) if value != 0}
        row = weights_row(given, names, f"{table}: {file}") if given else torch.zeros(len(names))
        expressions.append(Expression(path, row))
    return expressions


def _by_name(folder: Path, names: Sequence[str]) -> list[Expression]:
    expressions = []
    for path in _scans(folder):
        if path.stem.lower() == NEUTRAL:
            continue
        given: dict[str, float] = {}
        for word in path.stem.split("+"):
            name, equals, number = word.partition("=")
            if name.strip() in given:
                raise ValueRangeError(f"{path}: found {name.strip()!r} twice in its name, expected each shape once")
            try:
                given[name.strip()] = float(number) if equals else 1.0
            except ValueError:
                raise ValueRangeError(f"{path}: found {word!r} in its name, expected SHAPE=WEIGHT; {LAYOUT}") from None
        try:
            expressions.append(Expression(path, weights_row(given, names, str(path))))
        except NameMismatchError as error:
            raise NameMismatchError(f"{error}; either {LAYOUT}") from None
    return expressions


def check_side(actor: BlendshapeRig, weights: Tensor, found: Tensor, seen: Tensor) -> None:
    r"""Compares a registered expression with what was asked for and with its mirror image.

    .. math:: s = \frac{(x - m)^\top d}{d^\top d}, \qquad m = \tfrac12 (a + a'), \; d = \tfrac12 (a - a')

    of the expression a asked for and its mirror image a', along the skin's normals: what both sides do alike does not
    count, nor does what slides along the skin, which no registration sees.

    A head alone looks like another head when it is mirrored; an expression of one side does not.
    """
    weights = weights.to(actor.deltas)
    swapped = weights[mirror(actor.names).to(weights.device)]
    if torch.equal(swapped, weights):
        return
    asked, other = actor(torch.stack([weights, swapped])).double()
    telling = seen.to(asked.device) & ((asked - other).norm(dim=-1) > _TELLING)
    if int(telling.sum()) < _LEAST_VERTICES:
        return
    normals = vertex_normals(asked, actor.neutral.faces)[telling]
    there, asked, other = (((x - asked)[telling] * normals).sum(-1) for x in (found.to(asked), asked, other))
    half = (asked - other) / 2
    side = float(((there - (asked + other) / 2) * half).sum() / half.square().sum())
    if side < _CLEARLY_OTHER:
        distances = [float((there - x).square().mean().sqrt()) for x in (asked, other)]
        raise AlignmentError(
            f"shows the other side: {distances[0]:.2g} mm (root mean square, across the skin) from what it is named "
            f"for, {distances[1]:.2g} mm from the mirror image of that (side {side:.2f} of 1 to -1); the scans are "
            "mirrored (export them in right-handed axes), or left and right are swapped in their names"
        )


def check_expression(actor: BlendshapeRig, weights: Tensor, found: Tensor, seen: Tensor) -> None:
    """Refuses a registered expression that is as far from what it is named for as from the face at rest, along the
    skin's normals: it shows another expression or head, or none."""
    rest, asked = actor(torch.stack([torch.zeros_like(weights), weights]).to(actor.deltas)).double()
    normals = vertex_normals(asked, actor.neutral.faces)
    off = [((found.to(asked) - x) * normals).sum(-1)[seen.to(asked.device)] for x in (asked, rest)]
    named, still = (float(x.square().mean().sqrt()) if len(x) else 0.0 for x in off)
    if named > max(_TELLING, _UNSHOWN * still):
        raise AlignmentError(
            f"shows something else: {named:.2g} mm (root mean square, across the skin) from what it is named for, "
            f"{still:.2g} mm from the face at rest, expected clearly less than that; the name is another expression's, "
            "the scan shows another person or a face at rest, or the neutral scan is not at rest (--pose)"
        )


def seen_example(
    found: Mesh, expected: Tensor, seen: Tensor, data_weight: float = _DATA_WEIGHT, damping: float = _DAMPING
) -> Tensor:
    r"""The expression of a scan without what the scan has not shown, vertices (V,3), in the dtype of ``expected``.

    .. math:: \min_y \; \tau \sum_{v \in seen} \lVert y_v - (x_v - e_v) \rVert^2
        + \sum_{(v, w)} \lVert y_v - y_w \rVert^2 + \varphi \sum_v \lVert y_v \rVert^2, \quad \text{result } e + y

    over the edges (v, w) of the mesh: where a scan has holes or hair, and inside the mouth, the registered mesh follows
    its neighbours in another way each time, and the examples would teach that as the person's own. There the
    offset from what was expected is interpolated from the seen vertices and damped to zero within some edges.

    Args:
        found: the registered mesh x, aligned with ``expected``.
        expected: e, (V,3), the transferred rig in that expression, millimetres.
        seen: vertices that the scans show, (V,) bool.
        data_weight: :math:`\tau`.
        damping: :math:`\varphi`.
    """
    count = len(found.vertices)
    if expected.shape != (count, 3) or seen.shape != (count,):
        raise ShapeError(
            f"seen_example: found {tuple(expected.shape)} and {tuple(seen.shape)}, expected ({count},3), ({count},)"
        )
    first, second = edges(found.faces.cpu()).numpy().T
    half = sparse.coo_array((np.ones(len(first)), (first, second)), shape=(count, count)).tocsr()
    adjacency = half + half.T
    weight = data_weight * seen.cpu().double().numpy()
    system = sparse.diags_array(weight + damping + adjacency.sum(1)) - adjacency
    offsets = (found.vertices.double() - expected.double()).cpu().numpy()
    solved = SparseCholesky(system).solve(weight[:, None] * offsets)
    return (expected.double().cpu() + torch.from_numpy(solved)).to(expected)

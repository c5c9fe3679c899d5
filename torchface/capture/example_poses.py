"""Retargeting rules learned from example poses: a character's weights that an animator sets for given weights."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.retargeting import ShapeRule, shape_map
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.files.documents import read_toml
from torchface.io.tables.csv_table import TableReader
from torchface.optim.box_qp import box_qp
from torchface.shape_names import mapping, near_names, spelled_as
from torchface.shape_names.arkit_names import side_written_out

__all__ = ["ExamplePose", "LearnedRules", "learn_shape_rules", "load_example_poses"]

_RIDGE, _SPARSITY = 1e-5, 3e-3
_LARGEST_FACTOR = 4.0
_LEAST_FACTOR = 0.01
_CROSSED = 10.0  # times the sparsity, where a name says left and the other right
_TOGETHER = 0.999
_FROM, _TO = "from:", "to:"


@dataclass(frozen=True)
class ExamplePose:
    """A pose of a character for a pose of the source; shapes that are not listed are at 0.

    Args:
        name: for reports.
        source: weights in [0,1] by the source's shapes.
        target: weights in [0,1] by the character's.
    """

    name: str
    source: Mapping[str, float]
    target: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class LearnedRules:
    """What was learned of example poses.

    Args:
        rules: for ``shape_map``, by the character's shapes.
        poses: the examples' weights of the source, (P,N_from).
        wanted: those that the animator set, (P,N_to).
        found: those that the rules give, (P,N_to).
        notes: what the examples do not determine, for people to read.
    """

    rules: dict[str, ShapeRule]
    poses: Tensor
    wanted: Tensor
    found: Tensor
    notes: tuple[str, ...]


def load_example_poses(path: str | Path) -> list[ExamplePose]:
    r"""Reads example poses: TOML, or a CSV with a row for each pose.

    A CSV has the columns ``pose``, ``from:<shape>`` of the source and ``to:<shape>`` of the character; an empty cell is
    0. TOML has a table for each::

        [smile]
        from = {mouthSmileLeft = 1.0, mouthSmileRight = 1.0}
        to = {Smile = 0.8, CheekUp = 0.3}

    Raises:
        FileFormatError: the file is no such table.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("poses.csv").write_text("pose,from:jawOpen,to:Jaw\nopen,1,0.6\n")
        >>> load_example_poses("poses.csv")
        [ExamplePose(name='open', source={'jawOpen': 1.0}, target={'Jaw': 0.6})]
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        poses = []
        for name, entry in read_toml(path).table().items():
            entry.table("from", "to", expected="a table with from and to")
            sides = [
                {shape: weight.number("a weight") for shape, weight in entry[side].table().items()}
                for side in ("from", "to")
            ]
            poses.append(ExamplePose(name, *sides))
        return poses
    reader = TableReader(path)
    reader.require(["pose"])
    other = [name for name in reader.header if name != "pose" and not name.startswith((_FROM, _TO))]
    if other:
        raise FileFormatError(f"{path}: found the column {other[0]!r}, expected pose, from:<shape> and to:<shape>")
    table = reader.read(["pose"])
    rows = [dict(zip(table.names, row.tolist(), strict=True)) for row in table.numbers]
    return [
        ExamplePose(
            name,
            *(
                {key.removeprefix(side): weight for key, weight in row.items() if key.startswith(side) and weight > 0}
                for side in (_FROM, _TO)
            ),
        )
        for name, row in zip(table.texts["pose"], rows, strict=True)
    ]


def learn_shape_rules(poses: Sequence[ExamplePose], from_names: Sequence[str], to_names: Sequence[str]) -> LearnedRules:
    r"""Sums of source shapes, one a shape of the character, that give the poses an animator set.

    .. math:: \min_{0 \le c \le 4} \; \tfrac12 \sum_p (y_p - c^\top x_p)^2 + \tfrac{\rho}{2} \lVert c - m \rVert^2
        + \lambda \sum_{j \,\text{shown}} c_j

    for each shape of the character on its own, over the poses' weights x of the source and y of the character. m is
    what the names say, so what no pose shows stays as it is without examples; of two sides that poses show together
    each drives its own, where names end in the side or write it out. Then again without the sparsity, over the factors
    that it left.

    Args:
        poses: the examples; each is complete: what it does not list is 0.
        from_names, to_names: of the two rigs; poses may spell them otherwise.

    Returns:
        Rules for the shapes that a pose lists or whose sources by name a pose shows; factors have four digits.

    Raises:
        NameMismatchError: a pose names a shape that a rig lacks.
        ValueRangeError: there is no pose, one without a source, or a weight outside [0,1].

    Example:
        >>> poses = [ExamplePose("open", {"jawOpen": 1.0}, {"Jaw": 0.6}), ExamplePose("puff", {"cheekPuff": 1.0}, {})]
        >>> learn_shape_rules(poses, ["jawOpen", "cheekPuff"], ["Jaw", "Ear"]).rules["Jaw"].sum
        {'jawOpen': 0.6}
    """
    if not poses:
        raise ValueRangeError("example poses: found none, expected at least one")
    x = torch.stack([_row(pose.name, pose.source, from_names, "the source") for pose in poses])
    y = torch.stack([_row(pose.name, pose.target, to_names, "the character") for pose in poses])
    still = [pose.name for pose, row in zip(poses, x, strict=True) if not row.any()]
    if still:
        raise ValueRangeError(f"example pose {still[0]!r}: found no weight of the source above 0, expected one")
    named = mapping(from_names, to_names).double()
    shown = x.any(0)
    learned = (y.any(0) | (named[:, shown] != 0).any(1)).nonzero()[:, 0]
    gram = x.T @ x
    H = gram + _RIDGE * torch.eye(len(gram), dtype=torch.float64)
    f = -(y.T @ x + _RIDGE * named)[learned]
    crossed = _sides(to_names)[learned, None] * _sides(from_names) < 0
    sparse = box_qp(H, f + _SPARSITY * shown * torch.where(crossed, _CROSSED, 1.0), 0.0, _LARGEST_FACTOR)
    factors = torch.zeros_like(sparse)
    for row, kept in enumerate(sparse >= _LEAST_FACTOR):  # each shape has sources of its own
        if kept.any():
            factors[row, kept] = box_qp(H[kept][:, kept], f[row : row + 1, kept], 0.0, _LARGEST_FACTOR)[0]
    rules = {
        to_names[target]: ShapeRule(
            {from_names[source]: round(float(row[source]), 4) for source in (row >= _LEAST_FACTOR).nonzero()[:, 0]}
        )
        for target, row in zip(learned.tolist(), factors, strict=True)
    }
    mapped = shape_map(from_names, to_names, rules)(x)
    return LearnedRules(rules, x, y, mapped, tuple(_notes(x, shown, from_names)))


def _sides(names: Sequence[str]) -> Tensor:
    """1 for names that say left, -1 for right, 0 for others, (N,)."""
    written = [side_written_out(name).lower() for name in names]
    return torch.tensor([("left" in one) - ("right" in one) for one in written])


def _row(pose: str, weights: Mapping[str, float], names: Sequence[str], whose: str) -> Tensor:
    row = torch.zeros(len(names), dtype=torch.float64)
    for name, weight in weights.items():
        own = spelled_as(name, names)
        if own is None:
            raise NameMismatchError(
                f"example pose {pose!r}: found {name!r}, expected shapes of {whose}: {near_names([name], names)}"
            )
        if not 0 <= weight <= 1:
            raise ValueRangeError(f"example pose {pose!r}: found {name} = {weight:g}, expected a weight from 0 to 1")
        row[names.index(own)] = weight
    return row


def _notes(x: Tensor, shown: Tensor, names: Sequence[str]) -> list[str]:
    """Which sources the poses show only together, so that names decide who drives what, or each does in part."""
    columns = shown.nonzero()[:, 0]
    directions = torch.nn.functional.normalize(x[:, columns], dim=0)
    alike = (directions.T @ directions) > _TOGETHER
    notes, done = [], torch.zeros(len(columns), dtype=torch.bool)
    for i, group in enumerate(alike):
        if not done[i] and int(group.sum()) > 1:
            listed = ", ".join(names[column] for column in columns[group].tolist())
            notes.append(f"{listed} are on only together in the poses: add a pose of each alone, or names decide")
        done |= group
    return notes

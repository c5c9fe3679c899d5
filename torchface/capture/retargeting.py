"""One rig's weights on another: parallel parameterisation, by names and by a mapping table."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.files.documents import Value, read_toml, write_toml
from torchface.shape_names import mapping, near_names, recognised_mapping, spelled_as
from torchface.take import Take, Track

__all__ = ["ShapeMap", "ShapeRule", "load_shape_rules", "retarget_take", "save_shape_rules", "shape_map"]

_MAX_FACTORS = 8


@dataclass(frozen=True)
class ShapeRule:
    r"""The rule that drives one shape of the target rig.

    .. math:: w = \mathrm{clip}\Big(g \, \big(\textstyle\sum_i c_i w_i\big) \textstyle\prod_j w_j, \; l, \; u\Big)

    A sum alone splits, merges, or renames shapes; a product alone drives a combination shape (a corrective that
    comes in where others are active together).

    Args:
        sum: source shapes and their factors :math:`c`; without any the sum counts as 1.
        product: source shapes that are multiplied.
        gain: g.
        lower, upper: what the target takes.

    Example:
        >>> corrective = ShapeRule(product=("jawOpen", "mouthPucker"), gain=2.0)
        >>> shapes = shape_map(["jawOpen", "mouthPucker"], ["openPucker"], {"openPucker": corrective})
        >>> shapes(torch.tensor([[0.5, 0.5]])).tolist()
        [[0.5]]
    """

    sum: Mapping[str, float] = field(default_factory=dict)
    product: tuple[str, ...] = ()
    gain: float = 1.0
    lower: float = 0.0
    upper: float = 1.0


@dataclass(frozen=True, eq=False)
class ShapeMap:
    """The map from the weights of one rig to those of another.

    Args:
        from_names, to_names: of the two rigs.
        matrix: the sums, (N_to,N_from); all zero for a shape that is driven by products alone or by nothing.
        products: for each target shape the source shapes that are multiplied, as rows of ``from_names``.
        gain, lower, upper: one a target shape, (N_to,).

    Example:
        >>> shapes = shape_map(["jawOpen"], ["jawOpen", "tongueOut"])
        >>> shapes.undriven
        ('tongueOut',)
    """

    from_names: tuple[str, ...]
    to_names: tuple[str, ...]
    matrix: Tensor
    products: tuple[tuple[int, ...], ...]
    gain: Tensor
    lower: Tensor
    upper: Tensor

    @property
    def unused(self) -> tuple[str, ...]:
        """Source shapes that drive nothing."""
        used = self.matrix.any(0)
        for row in self.products:
            used[list(row)] = True
        return tuple(name for name, is_used in zip(self.from_names, used.tolist(), strict=True) if not is_used)

    @property
    def undriven(self) -> tuple[str, ...]:
        """Target shapes that nothing drives."""
        driven = self.matrix.any(1).tolist()
        rows = zip(self.to_names, driven, self.products, strict=True)
        return tuple(name for name, summed, product in rows if not summed and not product)

    def __call__(self, weights: Tensor) -> Tensor:
        """Weights (T,N_from) to weights (T,N_to), differentiable; a NaN stays in what it drives.

        Raises:
            ShapeError: another number of weights than ``from_names``.
        """
        if weights.ndim != 2 or weights.shape[1] != len(self.from_names):
            raise ShapeError(f"retarget: found weights {tuple(weights.shape)}, expected (T,{len(self.from_names)})")
        matrix = self.matrix.to(weights)
        # A NaN times a zero of the matrix is no NaN of the target.
        lost = weights.isnan().to(weights) @ (matrix != 0).to(weights).T > 0
        moved = torch.where(lost, torch.nan, weights.nan_to_num(0.0) @ matrix.T)
        columns = []
        for row, factors in enumerate(self.products):  # a loop over shapes, not frames: each has factors of its own
            column = moved[:, row]
            if factors:
                product = weights[:, list(factors)].prod(1)
                column = column * product if bool(self.matrix[row].any()) else product
            columns.append(column)
        driven = torch.stack(columns, 1) * self.gain.to(weights)
        return torch.minimum(torch.maximum(driven, self.lower.to(weights)), self.upper.to(weights))


def shape_map(
    from_names: Sequence[str], to_names: Sequence[str], rules: Mapping[str, ShapeRule] | None = None
) -> ShapeMap:
    """The map from one rig's shapes to another's: by rules where there are any, else by what the names mean.

    Names that mean the same shape match (``eyeBlinkLeft``, ``eyeBlink_L``), a whole shape drives both of its halves,
    two halves give the whole their mean; see :func:`torchface.shape_names.mapping`. So do other programs' names of
    ARKit's shapes, MetaHuman's curves, names to which one rig adds the same everywhere, and a source's action units
    (``AU12``) and morphs of MikuMikuDance. A name of several shapes
    joined by ``_`` or ``+`` (``jawOpen_mouthSmileLeft``), none of them its own in the source, is a combination shape:
    their product.

    Args:
        from_names: of the weights that are there.
        to_names: of the rig that shall move.
        rules: for shapes of the target rig, in place of what their names say; in any spelling of either's names.

    Raises:
        NameMismatchError: a rule is for a shape that the target lacks, names one that the source lacks, or nothing
            drives anything.
        ValueRangeError: a gain, limit or factor is not finite, or a lower limit above the upper.

    Example:
        >>> rules = {"jawDrop": ShapeRule({"jawOpen": 0.5})}
        >>> shapes = shape_map(["eyeBlinkLeft", "jawOpen"], ["eyeBlink_L", "jawDrop"], rules)
        >>> shapes(torch.tensor([[1.0, 0.5]])).tolist()
        [[1.0, 0.25]]
    """
    rules = _spelled(rules or {}, from_names, to_names)
    _check_rules(rules, from_names, to_names)
    matrix = recognised_mapping(from_names, to_names)
    column = {name: i for i, name in enumerate(from_names)}
    products: list[tuple[int, ...]] = []
    for row, name in enumerate(to_names):
        rule = rules.get(name)
        if rule is None:
            products.append(() if matrix[row].any() else _combination(name, from_names))
            continue
        matrix[row] = 0
        for source, factor in rule.sum.items():
            matrix[row, column[source]] = factor
        products.append(tuple(column[source] for source in rule.product))
    chosen = [rules.get(name, ShapeRule()) for name in to_names]
    made = ShapeMap(
        tuple(from_names),
        tuple(to_names),
        matrix,
        tuple(products),
        *(torch.tensor([getattr(rule, limit) for rule in chosen]) for limit in ("gain", "lower", "upper")),
    )
    if len(made.undriven) == len(made.to_names):
        raise NameMismatchError(
            f"retarget: found {', '.join(from_names[:5])}, ..., none of which is a shape of {', '.join(to_names[:5])}, "
            "...; expected common names, or a table that maps them (--table) or example poses (--poses)"
        )
    return made


def retarget_take(take: Take, shapes: ShapeMap) -> Take:
    """The take with its weights by another rig's names.

    Raises:
        ShapeError: the take has no weights by the names that the map comes from.

    Example:
        >>> from torchface import Track
        >>> take = Take(30.0, weights=Track(("EyeBlinkLeft",), torch.ones(2, 1, 1)))
        >>> shapes = shape_map(take.weights.names, ["eyeBlink_L", "jawOpen"])
        >>> retarget_take(take, shapes).weights.values[0, :, 0].tolist()
        [1.0, 0.0]
    """
    if take.weights is None or take.weights.names != shapes.from_names:
        raise ShapeError("retarget: found a take without weights of the map's shapes, expected them")
    weights = shapes(take.weights.values[..., 0])
    return replace(take, weights=Track(shapes.to_names, weights[..., None]))


def load_shape_rules(path: str | Path) -> dict[str, ShapeRule]:
    r"""Reads a mapping table, TOML::

        [browInnerUp]                       # a shape of the target rig
        sum = {browInnerUp_L = 0.5, browInnerUp_R = 0.5}
        gain = 1.2                          # all but a sum or a product may be left out
        lower = 0.0
        upper = 0.8

        [smileJawOpen]
        product = ["mouthSmileLeft", "jawOpen"]

    Raises:
        FileFormatError: the file is no such table.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("table.toml").write_text("[jawDrop]\nsum = {jawOpen = 0.5}\n")
        >>> load_shape_rules("table.toml")["jawDrop"].sum
        {'jawOpen': 0.5}
    """
    return {name: _rule(entry) for name, entry in read_toml(path).table().items()}


def save_shape_rules(rules: Mapping[str, ShapeRule], path: str | Path) -> None:
    """Writes a mapping table; see :func:`load_shape_rules`.

    Example:
        >>> save_shape_rules({"jawDrop": ShapeRule({"jawOpen": 0.5}, upper=0.8)}, "table.toml")
        >>> load_shape_rules("table.toml")["jawDrop"].upper
        0.8
    """
    document = {}
    for name, rule in rules.items():
        limits = {limit: getattr(rule, limit) for limit in ("gain", "lower", "upper")}
        changed = {limit: value for limit, value in limits.items() if value != getattr(ShapeRule, limit)}
        sums = {"sum": dict(rule.sum)} if rule.sum or not rule.product else {}
        document[name] = sums | ({"product": list(rule.product)} if rule.product else {}) | changed
    write_toml(path, document)


def _rule(entry: Value) -> ShapeRule:
    entry.table("sum", "product", "gain", "lower", "upper", expected="a table with sum or product")
    factors, product = entry["sum"], entry["product"]
    if not factors.found and not product.found:
        raise entry.error("sum or product")
    if product and len(product.texts("a list of source shapes")) > _MAX_FACTORS:
        raise product.error(f"at most {_MAX_FACTORS} source shapes")
    sums = factors.table(expected="source shapes with a factor each") if factors else {}
    return ShapeRule(
        {source: factor.number("a factor") for source, factor in sums.items()},
        product.texts() if product else (),
        **{limit: entry[limit].number() for limit in ("gain", "lower", "upper") if entry[limit]},
    )


def _spelled(
    rules: Mapping[str, ShapeRule], from_names: Sequence[str], to_names: Sequence[str]
) -> dict[str, ShapeRule]:
    """The rules in the names' own spelling; what neither knows stays."""

    def source(name: str) -> str:
        return spelled_as(name, from_names) or name

    spelled: dict[str, ShapeRule] = {}
    for name, rule in rules.items():
        own = spelled_as(name, to_names) or name
        if own in spelled:
            raise NameMismatchError(f"retarget: found two rules for {own}, expected one")
        factors = {source(given): factor for given, factor in rule.sum.items()}
        if len(factors) < len(rule.sum):
            raise NameMismatchError(f"retarget: the rule of {name} names a shape twice, {', '.join(rule.sum)}")
        spelled[own] = replace(rule, sum=factors, product=tuple(map(source, rule.product)))
    return spelled


def _check_rules(rules: Mapping[str, ShapeRule], from_names: Sequence[str], to_names: Sequence[str]) -> None:
    lacking = sorted(set(rules) - set(to_names))
    if lacking:
        raise NameMismatchError(
            f"retarget: found rules for {', '.join(lacking[:5])}, expected shapes of the target rig: "
            f"{near_names(lacking, to_names)}"
        )
    for name, rule in rules.items():
        unknown = sorted({*rule.sum, *rule.product} - set(from_names))
        if unknown:
            raise NameMismatchError(
                f"retarget: the rule of {name} names {', '.join(unknown[:5])}, expected shapes of the source: "
                f"{near_names(unknown, from_names)}"
            )
        numbers = (rule.gain, rule.lower, rule.upper, *rule.sum.values())
        if not all(map(math.isfinite, numbers)) or rule.lower > rule.upper:
            raise ValueRangeError(
                f"retarget: the rule of {name} has gain {rule.gain}, limits {rule.lower} to {rule.upper}, expected "
                "finite numbers and lower <= upper"
            )


def _combination(name: str, from_names: Sequence[str]) -> tuple[int, ...]:
    """The source shapes whose names a combination shape's name joins; none if it joins no others."""
    for joint in (r"\+", r"_(?!(?:l|r|left|right)(?:_|$))"):  # a side belongs to the name before it
        parts = re.split(joint, name, flags=re.IGNORECASE)
        if not 2 <= len(parts) <= _MAX_FACTORS or not all(parts):
            continue
        matches = mapping(from_names, parts)
        if bool((matches == 1).any(1).all()) and bool((matches.sum(1) == 1).all()):
            return tuple(int(row.argmax()) for row in matches)
    return ()

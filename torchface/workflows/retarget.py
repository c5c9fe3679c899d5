"""From weights on disk to another rig's weights and animation on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from torchface.capture.retarget import ShapeMap, load_shape_rules, retarget_take, shape_map
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.io import load_rig, load_take, save_animation
from torchface.io.weights import save_weights_csv
from torchface.take import Take, Track


@dataclass(frozen=True, eq=False)
class Retargeted:
    """What a retarget gave.

    Args:
        take: weights by the target's names.
        shapes: what drove what.
    """

    take: Take
    shapes: ShapeMap


def retarget_weights(
    weights: Path,
    to: Path,
    source: Path | None,
    table: Path | None,
    out: Path,
    animation: Path | None = None,
    part: str | None = None,
    progress: Callable[[str], None] | None = None,
) -> Retargeted:
    """Reads, maps, writes; see ``torchface retarget --help`` for the arguments.

    Raises:
        ValueRangeError: the file holds no weights.
        NameMismatchError: the names do not fit.
        TorchfaceError: any file is broken.
    """
    say = progress or (lambda line: None)
    say("reading")
    played = load_take(weights)
    if played.weights is None:
        raise ValueRangeError(f"{weights}: found no weights, expected a CSV of them")
    target = load_rig(to, part=part)
    if source is not None:
        rig = load_rig(source)
        # By the rig's own spelling, which is what a table names.
        played = replace(played, weights=Track(rig.names, rig.weights_from(played.weights)[..., None]))
    assert played.weights is not None
    rules = None if table is None else load_shape_rules(table)
    try:
        shapes = shape_map(played.weights.names, target.names, rules)
    except NameMismatchError as error:
        raise NameMismatchError(f"{table or weights}: {error}") from error
    moved = retarget_take(played, shapes)
    say("writing")
    for path in (out, animation):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
    save_weights_csv(moved, out)
    if animation is not None:
        save_animation(target, moved, animation)
    return Retargeted(moved, shapes)

"""From weights on disk to another rig's weights and animation on disk."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torchface.capture.retargeting import ShapeMap, load_shape_rules, retarget_take, shape_map
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.files.whole_files import check_writable, make_folder
from torchface.io import load_rig, load_take, save_animation
from torchface.progress import Progress, silent
from torchface.take import Take, Track
from torchface.workflows.weight_files import check_live_link, write_weights


@dataclass(frozen=True, eq=False)
class Retargeted:
    """What a retarget gave.

    Args:
        take: weights by the target's names.
        shapes: what drove what.
        warnings: what a file leaves out.
    """

    take: Take
    shapes: ShapeMap
    warnings: tuple[str, ...]


def retarget_weights(
    weights: Path,
    to: Path,
    source: Path | None,
    table: Path | None,
    out: Path,
    animation: Path | None = None,
    part: str | None = None,
    live_link: Path | None = None,
    progress: Progress | None = None,
) -> Retargeted:
    """Reads, maps, writes; see ``torchface retarget --help`` for the arguments.

    Raises:
        ValueRangeError: the file holds no weights.
        NameMismatchError: the names do not fit.
        TorchfaceError: any file is broken.
    """
    progress = progress or silent
    check_writable(out, live_link, animation)
    progress("reading")
    played = load_take(weights)
    if played.weights is None:
        raise ValueRangeError(f"{weights}: found no weights, expected a CSV of them")
    target = load_rig(to, part=part)
    check_live_link(target.names, live_link)
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
    progress("writing")
    written = write_weights(moved, out, live_link)
    if animation is not None:
        make_folder(animation.parent)
        save_animation(target, moved, animation)
    return Retargeted(moved, shapes, tuple(written))

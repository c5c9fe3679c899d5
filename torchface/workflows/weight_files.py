"""Weights on disk as the commands write them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig.eye_geometry import Eyeballs
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.escaped_text import listed
from torchface.files.whole_files import all_or_none, check_ending, check_writable, make_folder, write_file
from torchface.io.gltf.animation_reading import turns_nodes
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.performance_animation import Performance, performed_glb
from torchface.io.rig_files import ANIMATION_ENDINGS, GLTF_ENDINGS, SCENE_ENDINGS, load_animation, save_animation
from torchface.io.scenes.weight_keys import weight_keys, with_correctives
from torchface.io.tables.csv_table import TableReader
from torchface.io.take_files import load_take
from torchface.io.weights.action_unit_csv import is_action_unit_header, load_action_units
from torchface.io.weights.live_link_csv import not_in_live_link, save_live_link
from torchface.io.weights.weight_csv import ROTATIONS, save_weights_csv
from torchface.number_checks import checked_number
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.take import Take, Track
from torchface.temporal.interpolation import values_at
from torchface.temporal.key_reduction import KeyReduction, kept_keys, reduction_error
from torchface.workflows.head_rotations import still_head_columns

_KEPT = (".glb", ".vrm")  # rigs' files that are written again with all that they have
_SEEN = 0.01  # of a weight: less moves nothing that is seen
_ROUNDED = 1e-3  # what a file's rounding leaves beyond 0 or 1


@dataclass(frozen=True)
class WeightFiles:
    """What is written of a take's weights."""

    out: Path  # the weights, see write_weights
    animation: Path | None = None  # the rig with this animation, .glb, USD or .ma, if wanted
    live_link: Path | None = None  # Live Link Face's CSV whatever the names are, if wanted
    # Keep as few keys as stay within this of every frame's weights; a row and a key a frame if absent.
    reduce: float | None = None

    def __post_init__(self) -> None:
        if self.animation is None and self.out.suffix.lower() in ANIMATION_ENDINGS:
            raise FileFormatError(
                f"{self.out}: found the ending {self.out.suffix!r} for the weights, expected .csv; the animated rig is "
                f"written by --animation {self.out}"
            )

    def check(self, folder: Path | None = None) -> None:
        """Raises where one of them, or a folder beside, cannot be written to or has another ending than it may have."""
        for table in (self.out, self.live_link):
            if table is not None:
                check_ending(table, ".csv")
        checked_reduction(self.reduce)
        check_writable(self.out, self.live_link, self.animation, folder=folder)
        if self.animation is not None:
            check_ending(self.animation, *ANIMATION_ENDINGS)


def load_weight_take(path: Path) -> Take:
    """A take that has weights, or an animated rig's file as one; of OpenFace's table the action units."""
    ending = path.suffix.lower()
    if ending == ".csv" and is_action_unit_header(TableReader(path).header):
        return load_action_units(path)
    take = load_animation(path) if ending in SCENE_ENDINGS else load_take(path)
    if take is None or take.weights is None:
        raise ValueRangeError(
            f"{path}: found no weights, expected a weight take such as Live Link Face's, or an animated rig"
        )
    check_whole_frames(path, take.weights)
    return take


def unread_turns(path: Path) -> tuple[str, ...]:
    """A line where an animated rig's head or eyes turn, of which :func:`load_weight_take` reads nothing."""
    turns = path.suffix.lower() in GLTF_ENDINGS and turns_nodes(path)
    return (f"{path}: the weights of its shapes are read, not how its head and eyes turn",) if turns else ()


def without_shape(rig: BlendshapeRig, weights: Track | None) -> list[str]:
    """A warning, as the rest of a line, where shapes that move in weights (T,N,1) are none of a rig's."""
    assert weights is not None
    lost = (weights.values[..., 0].nan_to_num().abs() > _SEEN).any(0) & ~mapping(weights.names, rig.names).any(0)
    names = [weights.names[row] for row in lost.nonzero()[:, 0].tolist()]
    return [f"has no shape for {', '.join(names)}, which move in"] if names else []


def check_whole_frames(path: Path, weights: Track) -> None:
    """Raises ``ValueRangeError`` where a frame of weights (T,N,1) lacks some of them; one without a face lacks all."""
    missing = ~torch.isfinite(weights.values)
    faceless = missing.all(1, keepdim=True)
    if (missing & ~faceless).any():
        partial = Track(weights.names, weights.values.masked_fill(faceless, 0.0))
        raise ValueRangeError(
            f"{path}: found that {weight_faults(partial)[0]}; expected a number in each cell, or a row without any "
            "where no face was seen (leave out a shape that was not recorded)"
        )


def checked_reduction(bound: float | None) -> float | None:
    """The bound of ``--reduce``, where it is one."""
    return bound if bound is None else checked_number("--reduce", bound, 0.0, 1.0, above=True)


def weight_faults(weights: Track) -> list[str]:
    """What is wrong with weights (T,N,1), in lines for people to read: missing ones, and those beyond 0 and 1."""
    values = weights.values[..., 0]
    lines = []
    for what, wrong in (
        ("missing", ~torch.isfinite(values)),
        ("below 0 or above 1", (values < -_ROUNDED) | (values > 1 + _ROUNDED)),
    ):
        count = int(wrong.sum())
        if not count:
            continue
        frame, channel = wrong.nonzero()[0].tolist()
        shapes = [weights.names[row] for row in wrong.any(0).nonzero()[:, 0].tolist()]
        first = "" if what == "missing" else f", {float(values[frame, channel]):g}"
        span = "" if what == "missing" else f" ({float(values[wrong].min()):.3g} to {float(values[wrong].max()):.3g})"
        lines.append(
            f"{count} weights are {what}{span}, of {listed(shapes)}; the first is "
            f"{weights.names[channel]} in frame {frame}{first}"
        )
    return lines


def check_live_link(names: Sequence[str], target: Path | str | None) -> None:
    """Raises ``NameMismatchError`` where Live Link Face's file or packets are asked for and could hold no shape."""
    if target is not None and not mapping(names, ARKIT).any():
        raise NameMismatchError(
            f"{target}: found a rig with {', '.join(names[:4])}, ..., expected at least one of ARKit's shapes for Live "
            "Link Face; --out writes the rig's own names, and torchface retarget gives them ARKit's"
        )


def with_eyes(take: Take, rig: BlendshapeRig) -> Take:
    """A take with the rotations of the eyes that its weights say, unless it comes with columns of its own."""
    if "columns" in take.extras:
        return take
    assert take.weights is not None
    onto = mapping(take.weights.names, ARKIT).to(take.weights.values)
    weights = Track(ARKIT, (take.weights.values[..., 0] @ onto.T)[..., None])
    return replace(take, extras=take.extras | {"columns": still_head_columns(weights, Eyeballs.of(rig).turns)})


def write_weights(
    take: Take, files: WeightFiles, rig: BlendshapeRig, source: Path | None = None
) -> tuple[list[str], list[str]]:
    """Writes a take's weights; warnings of what a file leaves out, and lines of how many keys it has.

    ``files.out`` is Live Link Face's CSV where it gives every shape back, because all are ARKit's; else
    ``frame,time,<shape>,...`` with every shape by its own name.
    """
    assert take.weights is not None
    lost, few = not_in_live_link(take.weights.names), take
    warnings: list[str] = []
    notes: list[str] = []
    if files.reduce is not None:
        few, reduction = reduced_take(take, files.reduce)
        notes.append(f"{files.out}: {reduction}")
    make_folder(files.out.parent)
    with all_or_none():
        if lost:
            save_weights_csv(few, files.out)
        else:
            save_live_link(with_eyes(few, rig), files.out)
        if files.live_link is not None:
            make_folder(files.live_link.parent)
            save_live_link(with_eyes(few, rig), files.live_link)
    names = take.weights.names
    rows = (mapping(ARKIT, names) @ mapping(names, ARKIT)).tolist()  # a whole shape comes back from its two halves
    lost = tuple(name for i, name in enumerate(names) if rows[i] != [float(i == k) for k in range(len(names))])
    if lost and files.live_link is not None:
        warnings.append(f"{files.live_link} does not give back (halves are merged, others left out): {listed(lost)}")
    if files.animation is not None:
        make_folder(files.animation.parent)
        whole, count = filled(take)
        if count:
            warnings.append(f"{files.animation}: {count} frames without a face take what lies between their neighbours")
        reduced = write_animation(rig, whole, files.animation, files.reduce, source)
        notes += [] if reduced is None else [f"{files.animation}: {reduced}"]
        if source is not None and source.suffix.lower() == ".gltf":
            warnings.append(
                f"{files.animation} has the meshes of {source} alone; packed, it keeps nodes, skeleton and materials: "
                f"npx @gltf-transform/cli copy {source} {source.with_suffix('.glb')}"
            )
    return warnings, notes


def filled(take: Take) -> tuple[Take, int]:
    """A take whose frames without weights and rotations have those between the frames beside them, and their number."""
    assert take.weights is not None
    seen = torch.isfinite(take.weights.values).flatten(1).all(1).nonzero()[:, 0]
    if not 0 < len(seen) < len(take):
        return take, 0

    def between(values: Tensor) -> Tensor:
        return values_at(values[seen], take.times[seen], take.times)

    columns = take.extras.get("columns", {})
    turns = {name: between(column) for name, column in columns.items() if name in ROTATIONS}
    extras = take.extras | ({"columns": columns | turns} if turns else {})
    weights = Track(take.weights.names, between(take.weights.values))
    return replace(take, weights=weights, extras=extras), len(take) - len(seen)


def write_animation(
    rig: BlendshapeRig, take: Take, path: Path, reduce: float | None = None, source: Path | None = None
) -> KeyReduction | None:
    """Writes a rig with a take as its animation, and says how many keys that has where few were asked for.

    Where the rig comes from a ``.glb`` or ``.vrm``, ``source``, a ``.glb`` is that file, with all that it has, and the
    take as its first animation: weights, and the rotations of head and eyes that the take has.
    """
    if source is None or source.suffix.lower() not in _KEPT or path.suffix.lower() != ".glb":
        return save_animation(rig, take, path, reduce=reduce).reduction
    taken, reduction = (take, None) if reduce is None else reduced_take(take, reduce)
    keys = with_correctives(rig, weight_keys(rig, taken)[0])
    names = (*rig.names, *(() if rig.correctives is None else rig.correctives.names))
    columns = taken.extras.get("columns", {})
    turns = None
    if all(name in columns for name in ROTATIONS):
        angles = torch.stack([torch.as_tensor(columns[name]) for name in ROTATIONS], 1).double().nan_to_num(0.0)
        turns = angles.numpy() if bool(angles.any()) else None
    performance = Performance(keys.seconds.numpy(), names, keys.weights.numpy(), turns)
    write_file(path, performed_glb(read_document(source), performance))
    return reduction


def reduced_take(take: Take, bound: float) -> tuple[Take, KeyReduction]:
    """The take at as few of its frames as keep weights and rotations between them within a bound; see ``kept_keys``."""
    assert take.weights is not None
    columns = [column for column in take.extras.get("columns", {}).values() if isinstance(column, torch.Tensor)]
    values = torch.cat([take.weights.values[..., 0].double(), *(column[:, None].double() for column in columns)], 1)
    kept = kept_keys(take.times, values, bound)
    reduction = KeyReduction(len(kept), int(kept.sum()), reduction_error(take.times, values, kept))
    return take.rows(kept.nonzero()[:, 0]), reduction

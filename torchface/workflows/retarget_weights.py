"""From weights on disk to another rig's weights and animation on disk."""

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchface.capture.example_poses import LearnedRules, learn_shape_rules, load_example_poses
from torchface.capture.mouth_close_conventions import (
    CLOSE,
    JAW,
    jaw_into_mouth_close,
    jaw_out_of_mouth_close,
    mouth_close_of,
)
from torchface.capture.retargeting import ShapeMap, load_shape_rules, retarget_take, save_shape_rules, shape_map
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.files.whole_files import make_folder
from torchface.io import load_rig
from torchface.progress import Progress, silent
from torchface.rendering.compositing import save_rendered_image
from torchface.rig import BlendshapeRig
from torchface.shape_names import arkit_sources
from torchface.take import Take, Track
from torchface.viz.figures.face_views import pose_pairs
from torchface.workflows.posed_mesh import size_faults
from torchface.workflows.weight_files import (
    WeightFiles,
    check_live_link,
    load_weight_take,
    unread_turns,
    weight_faults,
    without_shape,
    write_weights,
)


@dataclass(frozen=True, eq=False)
class Retargeted:
    """What a retarget gave."""

    take: Take  # weights by the target's names
    shapes: ShapeMap
    warnings: tuple[str, ...]  # what a file leaves out, what examples do not determine
    notes: tuple[str, ...] = ()  # what was learned of examples, and how many keys files have
    driven: tuple[str, ...] = ()  # shapes of the target that move, and something drives them
    undriven: tuple[str, ...] = ()  # that move, and nothing drives them
    still: tuple[str, ...] = ()  # that have weights in a frame and no motion


def retarget_weights(
    weights: Path,
    to: Path,
    files: WeightFiles,
    source: Path | None = None,
    table: Path | None = None,
    part: str | None = None,
    progress: Progress | None = None,
    poses: Path | None = None,
) -> Retargeted:
    """Reads, maps, writes; see ``torchface retarget --help`` for the arguments."""
    progress = progress or silent
    files.check()
    progress("reading")
    played = load_weight_take(weights)
    assert played.weights is not None
    faults = [f"{weights}: {fault}" for fault in weight_faults(played.weights)]
    faceless = ~torch.isfinite(played.weights.values).flatten(1).any(1)
    if files.animation is not None and bool(faceless.all()):
        raise ValueRangeError(f"{faults[0]}; expected a frame with a face for an animation (leave out --animation)")
    target = load_rig(to, part=part)
    check_live_link(target.names, files.live_link)
    faults += [f"{to}: {fault}, which changes no weight" for fault in size_faults(target.neutral)]
    rig = None
    if source is not None:
        rig = load_rig(source)
        faults += [f"{source} {lost} {weights}" for lost in without_shape(rig, played.weights)]
        # By the rig's own spelling, which is what a table names.
        played = replace(played, weights=Track(rig.names, rig.weights_from(played.weights)[..., None]))
    assert played.weights is not None
    said = unread_turns(weights)
    rules = {} if table is None else load_shape_rules(table)
    if poses is not None:
        learned, compared = _learned(poses, played.weights.names, target, files.out)
        rules, faults, said = learned.rules | rules, [*faults, *learned.notes], (*said, *compared)
    try:
        shapes = shape_map(played.weights.names, target.names, rules)
    except NameMismatchError as error:
        raise NameMismatchError(f"{table or poses or weights}: {error}") from error
    faults += _unmatched(played.weights, shapes, weights, to)
    moved, notes = _mouth_closed(retarget_take(played, shapes), rig, target, rules)
    assert moved.weights is not None
    moved.weights.values[faceless] = torch.nan  # of shapes that nothing drives as well
    progress("writing")
    left_out, written = write_weights(moved, files, target, to if part is None else None)
    moves, weighed = target.deltas.flatten(1).any(1), (moved.weights.values.nan_to_num() != 0).flatten(2).any(2).any(0)
    undriven = torch.tensor([name in shapes.undriven for name in target.names])
    # An identity shape such as Blender's Basis is nobody's loss.
    driven, open_ones, still = (
        tuple(name for name, is_one in zip(target.names, rows.tolist(), strict=True) if is_one)
        for rows in (moves & ~undriven, moves & undriven, ~moves & weighed)
    )
    return Retargeted(moved, shapes, (*faults, *notes, *left_out), (*said, *written), driven, open_ones, still)


def _unmatched(weights: Track, shapes: ShapeMap, source: Path, target: Path) -> list[str]:
    """What to say where most of what moves drives nothing."""
    moves = (weights.values.nan_to_num() != 0).any(0)
    moving = {name for name, moved in zip(weights.names, moves, strict=True) if moved}
    lost = moving & set(shapes.unused)
    if 2 * len(lost) <= len(moving):
        return []
    return [
        f"only {len(moving) - len(lost)} of the {len(moving)} shapes that move in {source} drive a shape of {target}: "
        "the others are lost; names, a table (--table) or example poses (--poses) say what drives what"
    ]


def _learned(
    path: Path, names: Sequence[str], target: BlendshapeRig, out: Path
) -> tuple[LearnedRules, tuple[str, ...]]:
    """Rules from example poses, kept as a table and drawn beside the weights, and lines for people to read."""
    examples = load_example_poses(path)
    try:
        learned = learn_shape_rules(examples, names, target.names)
    except (NameMismatchError, ValueRangeError) as error:
        raise type(error)(f"{path}: {error}") from error
    off = (learned.found - learned.wanted).abs()
    pose, shape = divmod(int(off.argmax()), off.shape[1])
    factors = sum(len(rule.sum) for rule in learned.rules.values())
    table, picture = (out.with_name(f"{out.stem}_{what}") for what in ("table.toml", "poses.png"))
    make_folder(out.parent)
    save_shape_rules(learned.rules, table)
    titles = [example.name for example in examples]
    save_rendered_image(pose_pairs(target, titles, learned.wanted, learned.found), picture)
    return learned, (
        f"{table}: {factors} factors for {len(learned.rules)} shapes from {len(examples)} poses, which they give "
        f"within {float(off.max()):.3f} ({target.names[shape]} in {titles[pose]}); drawn in {picture}",
    )


def _mouth_closed(
    take: Take, source: BlendshapeRig | None, target: BlendshapeRig, ruled: Collection[str]
) -> tuple[Take, list[str]]:
    """The take in the convention of the target's ``mouthClose``, and notes for the user; shapes that a table drives,
    ``ruled``, stay."""
    assert take.weights is not None
    try:
        wanted, found = mouth_close_of(target), None if source is None else mouth_close_of(source)
    except ValueRangeError as error:
        return take, [f"{CLOSE} is taken as it is: {error}"]
    opens = found is not None and found.opens_jaw
    given = arkit_sources(list(ruled))
    if wanted is None or wanted.opens_jaw is opens or JAW in given or CLOSE in given:
        return take, []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        moved = jaw_into_mouth_close(take.weights) if wanted.opens_jaw else jaw_out_of_mouth_close(take.weights)
    how = "opens the jaw itself: its weight is taken from" if wanted.opens_jaw else "leaves it to"
    said = f"the target's {CLOSE} {how} {JAW}{'' if wanted.opens_jaw else ', which takes its weight on'}"
    return replace(take, weights=moved), [said, *(str(one.message) for one in caught)]

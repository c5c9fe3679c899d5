"""What was done to a take on purpose is found, named and undone; what is right stays as it was."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture import MarkerSolver, clean_take
from torchface.capture.markers.cleaning.take_cleaning import Cleanup
from torchface.errors import NameMismatchError
from torchface.geometry.similarity import Similarity
from torchface.synthetic.stages.marker_stage import Recording, StageFlaws, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]
# Three samples in ten missing, one in a hundred mislabelled; ten-frame holes come on top.
DIRT = StageFlaws(missing=0.3, swaps=60, swap_seconds=1.0)


def with_holes(recording: Recording, attachment: Attachment, rig: BlendshapeRig, generator: torch.Generator) -> Take:
    """Ten frames without any of fifteen neighbours, every second or two."""
    values = recording.take.markers.values.clone()
    points = attachment.on(rig.neutral.faces, rig.vertices)
    near = torch.cdist(points, points).argsort(1)[:, :15]
    for _ in range(len(values) // 100):
        first = int(torch.randint(len(values) - 10, (1,), generator=generator))
        values[first : first + 10, near[int(torch.randint(len(points), (1,), generator=generator))]] = torch.nan
    return replace(recording.take, markers=Track(recording.take.markers.names, values))


def named(recording: Recording, take: Take, cleanup: Cleanup) -> tuple[int, int]:
    """How many of the stretches with exchanged labels, as far as they show, are named; and of how many."""
    count, shown = 0, 0
    for swap in recording.swaps:
        frames = torch.arange(swap.first, swap.last)
        visible = (~torch.isnan(take.markers.values[frames][:, list(swap.markers), 0])).any(1)
        if not visible.any():
            continue
        shown += 1
        pair = {take.markers.names[m] for m in swap.markers}
        covered = torch.zeros(len(frames), dtype=torch.bool)
        for defect in cleanup.defects:
            if defect.kind == "swap" and set(defect.labels) == pair:
                covered |= (frames >= defect.first) & (frames <= defect.last)
        count += bool((covered & visible).sum() >= 0.5 * visible.sum())
    return count, shown


def test_a_dirty_take_of_the_performer(performance: Performance) -> None:
    rig, attachment, takes = performance
    solver, true = MarkerSolver(rig, attachment), takes[0][:600]
    generator = torch.Generator().manual_seed(0)
    recording = record(rig, attachment, true, generator, DIRT)
    dirty = with_holes(recording, attachment, rig, generator)
    clean = record(rig, attachment, true, generator).take.markers
    before = dirty.markers.values.clone()
    cleanup = clean_take(solver, dirty)
    torch.testing.assert_close(dirty.markers.values, before, rtol=0, atol=0, equal_nan=True)
    rows = slice(None, None, 10)

    def error(markers: Tensor) -> float:
        return float((solver(markers[rows]) - true[rows]).abs().mean())

    assert error(cleanup.filled.markers.values) <= 1.25 * error(clean.values)
    assert error(cleanup.take.markers.values) <= 1.35 * error(clean.values)
    assert error(before) > 1.5 * error(clean.values)
    count, shown = named(recording, dirty, cleanup)
    assert shown > 7
    assert count >= 0.9 * shown
    swapped = torch.zeros(before.shape[:2], dtype=torch.bool)
    for swap in recording.swaps:
        swapped[swap.first : swap.last, list(swap.markers)] = True
    good = ~torch.isnan(before).any(-1) & ~swapped
    assert (cleanup.masked & good).sum() < 0.01 * good.sum()
    kept = good & ~torch.isnan(cleanup.take.markers.values).any(-1)
    assert torch.equal(cleanup.take.markers.values[kept], before[kept])


def spoiled(take: Take) -> Take:
    """A spike, a marker that drifts, one that falls off, two neighbours exchanged, a short and a long gap."""
    values = take.markers.values.clone()
    values[100, 10] += torch.tensor([8.0, 0, 0])
    values[200:, 20] += torch.linspace(0, 15, len(values) - 200)[:, None] * torch.tensor([0.0, -0.8, 0.6])
    values[350:, 30] = torch.tensor([20.0, -300, 0])
    values[150:190, [40, 41]] = values[150:190, [41, 40]]
    values[300:306, 50] = torch.nan
    values[300:360, 51] = torch.nan
    return replace(take, markers=Track(take.markers.names, values))


@pytest.mark.parametrize("slip", [pytest.param(False, marks=pytest.mark.bench), True])
def test_each_defect_is_named_with_its_frames(performance: Performance, stage_space: Similarity, slip: bool) -> None:
    rig, attachment, takes = performance
    flaws = StageFlaws(slip_translation=8, slip_rotation=3) if slip else StageFlaws()
    recording = record(rig, attachment, takes[0][:500], torch.Generator().manual_seed(3), flaws)
    whole = recording.take.markers.values
    take = spoiled(recording.take)
    moved = replace(take, markers=Track(take.markers.names, stage_space.apply(take.markers.values)))
    solver = MarkerSolver(rig, attachment, stage_space.inverse())
    cleanup = clean_take(solver, moved, slip)
    assert solver.alignment is not None
    found = {(defect.kind, defect.labels): defect for defect in cleanup.defects}
    assert {kind for kind, _ in found} == {"swap", "spike", "displaced", "gap"}
    swap = found["swap", ("M041", "M042")]
    assert (swap.first, swap.last, swap.action) == (150, 189, "swapped back")
    spike = found["spike", ("M011",)]
    assert (spike.first, spike.last, spike.action) == (100, 100, "masked")
    assert abs(spike.size - 8) < 1.5
    drift, fallen = found["displaced", ("M021",)], found["displaced", ("M031",)]
    assert 200 < drift.first < 300
    assert drift.last == 499
    assert (fallen.first, fallen.last) == (350, 499)
    assert found["gap", ("M051",)].action == "filled"
    assert found["gap", ("M052",)].action == "left"
    filled = stage_space.inverse().apply(cleanup.filled.markers.values)
    assert (filled[300:306, 50] - whole[300:306, 50]).norm(dim=-1).max() < 2.5
    assert torch.isnan(filled[300:360, 51]).all()
    torch.testing.assert_close(filled[150:190, 40:42], whole[150:190, 40:42], rtol=0, atol=1e-2)
    # Everything else is as it was.
    other = [m for m in range(100) if m not in (10, 20, 30, 40, 41, 50, 51)]
    assert not cleanup.masked[:, other].any()
    # Where the drift begins a single frame may stick out.
    assert {labels for kind, labels in found if kind == "spike"} <= {("M011",), ("M021",)}
    assert cleanup.summary().startswith("1 swap, ")
    assert ("swap", "M041 ↔ M042", "150–189") in [row[:3] for row in cleanup.table()]
    assert all(row[0] != "gap" for row in cleanup.table(gaps=False))


def test_a_clean_take_stays_bit_for_bit(performance: Performance) -> None:
    rig, attachment, takes = performance
    take = record(rig, attachment, takes[1][:200], torch.Generator().manual_seed(0), StageFlaws(missing=0.01)).take
    few = Take(60.0, markers=take.markers.select(list(reversed(take.markers.names[:90]))))
    cleanup = clean_take(MarkerSolver(rig, attachment), few)
    assert cleanup.take.markers.names == few.markers.names
    torch.testing.assert_close(cleanup.take.markers.values, few.markers.values, rtol=0, atol=0, equal_nan=True)
    assert not cleanup.masked.any()
    assert {defect.kind for defect in cleanup.defects} <= {"gap"}
    with pytest.raises(NameMismatchError, match="no markers"):
        clean_take(MarkerSolver(rig, attachment), Take(60.0))

"""Exchanged labels are found with and without a rig, in part of a take and in all of it; labels in order are left."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Track
from torchface.capture import MarkerSolver, clean_take
from torchface.capture.markers.cleaning.label_swaps import Swap, find_swaps_by_shape, swapped_back
from torchface.synthetic.stages.marker_stage import Recording, StageFlaws, record

Performance = tuple[BlendshapeRig, Attachment, list[Tensor]]
FLAWS = StageFlaws(noise=0.3, missing=0.02, slip_translation=4, slip_rotation=3)


@pytest.fixture(scope="module")
def recording(performance: Performance) -> Recording:
    rig, attachment, takes = performance
    return record(rig, attachment, takes[0][:300], torch.Generator().manual_seed(2), FLAWS)


@pytest.fixture(scope="module")
def markers(recording: Recording) -> Tensor:
    return recording.take.markers.values.double()


def neighbour(markers: Tensor, a: int, rank: int) -> int:
    median = markers.nanmedian(0).values
    return int((median - median[a]).norm(dim=1).argsort()[rank])


@pytest.mark.parametrize(  # each marker, rank and stretch twice or thrice everyday
    ("marker", "rank", "first", "last"),
    [
        pytest.param(marker, rank, *part, marks=() if (i + j + k) % 3 == 0 and k < 2 else pytest.mark.bench)
        for i, marker in enumerate((0, 23, 71))
        for j, rank in enumerate((1, 3, 60))
        for k, part in enumerate([(120, 121), (40, 67), (20, 155)])
    ],
)
def test_labels_exchanged_in_less_than_half_are_found_by_shape(
    markers: Tensor, marker: int, rank: int, first: int, last: int
) -> None:
    pair = (marker, neighbour(markers, marker, rank))
    swap = Swap((min(pair), max(pair)), first, last)
    dirty = swapped_back(markers, [swap])
    found = find_swaps_by_shape(dirty, 60.0)
    seen = ~torch.isnan(markers[:, list(pair), 0])
    both = seen.all(1)
    assert {swap.markers for swap in found} == ({swap.markers} if both[first:last].any() else set())
    # Frames that show both are back in their place.
    repaired = swapped_back(dirty, found)[both][:, list(pair)]
    torch.testing.assert_close(repaired, markers[both][:, list(pair)], rtol=0, atol=0)


def test_labels_in_order_are_left(performance: Performance, markers: Tensor) -> None:
    assert find_swaps_by_shape(markers, 60.0) == []
    noisy = markers + torch.randn(markers.shape, generator=torch.Generator().manual_seed(0), dtype=markers.dtype)
    noisy[50, 4] += 40.0
    assert find_swaps_by_shape(noisy, 60.0) == []
    assert find_swaps_by_shape(torch.full_like(markers, torch.nan), 60.0) == []


@pytest.mark.bench
@pytest.mark.real
def test_labels_in_order_are_left_in_real_takes(real_capture: Performance) -> None:
    rig, attachment, takes = real_capture
    for seed, weights in enumerate(takes):
        take = record(rig, attachment, weights[::4], torch.Generator().manual_seed(seed), FLAWS).take
        assert find_swaps_by_shape(take.markers.values.double(), 15.0) == []


@pytest.mark.parametrize("cycle", [pytest.param((0, 60), marks=pytest.mark.bench), (23, 24), (5, 40, 70)])
def test_labels_exchanged_in_the_whole_take_are_found_and_put_back(
    performance: Performance, recording: Recording, cycle: tuple[int, ...]
) -> None:
    rig, attachment, _ = performance
    values = recording.take.markers.values
    dirty = values.clone()
    dirty[:, list(cycle)] = values[:, [*cycle[1:], cycle[0]]]
    names = attachment.labels or ()
    cleanup = clean_take(MarkerSolver(rig, attachment), replace(recording.take, markers=Track(names, dirty)), slip=True)
    swaps = [defect for defect in cleanup.defects if defect.kind == "swap"]
    assert [(set(swap.labels), swap.first, swap.last) for swap in swaps] == [({names[m] for m in cycle}, 0, 299)]
    kept = ~cleanup.masked & ~torch.isnan(values).any(-1)
    assert torch.equal(cleanup.take.markers.values[kept], values[kept])

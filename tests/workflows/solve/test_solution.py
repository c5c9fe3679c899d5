"""A take with faults solves as well as the same take without them, or the user is told."""

import re
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.errors import AlignmentError
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.synthetic import performer
from torchface.synthetic.stages import StageFlaws, perform, place_markers, record
from torchface.workflows.solve.solution import Solution, SolveReport, SolveSettings, solve_markers
from torchface.workflows.solve.take_check import check_head

Capture = tuple[BlendshapeRig, Attachment, list[Tensor]]
BENCH = pytest.mark.bench
AS_IN_THE_HOW_TO = SolveSettings(align=True, clean=True, slip=True, free_scale=False)


@pytest.fixture(scope="module")
def stage(performer_rig: BlendshapeRig) -> Capture:
    """The embedded performer with half of its shapes, 60 markers on it, and 60 frames of its weights."""
    weights = perform(60, torch.Generator().manual_seed(4)).weights
    return performer_rig, place_markers(performer_rig, 60), [performer_rig.weights_from(weights)]


@pytest.fixture(scope="module")
def performer_rig() -> BlendshapeRig:
    rig = performer(texture=False)
    return rig.select([name for name in rig.names if name == "jawOpen" or rig.names.index(name) % 2])


def recorded(
    capture: Capture, which: int = 0, frames: int = 120, seed: int = 0, slips: bool = True
) -> tuple[Take, Tensor]:
    """A take through a helmet that slips, somewhere else on the stage, in millimetres; and its true weights."""
    rig, sites, takes = capture
    flaws = StageFlaws(noise=0.3, slip_translation=4.0 * slips, slip_rotation=2.0 * slips)
    true = takes[which][:frames]
    take = record(rig, sites, true, torch.Generator().manual_seed(seed), flaws).take
    angle = torch.tensor(0.8)
    turn = torch.tensor([[angle.cos(), 0, angle.sin()], [0, 1, 0], [-angle.sin(), 0, angle.cos()]])
    space = Similarity(torch.ones(1), turn[None], torch.tensor([[100.0, -900.0, 40.0]]))
    return replace(take, markers=Track(take.markers.names, space.apply(take.markers.values))), true


def exchanged(take: Take, pair: tuple[int, int], first: int, last: int) -> Take:
    """Two labels exchanged from one frame to before another."""
    values = take.markers.values.clone()
    values[first:last, list(pair)] = values[first:last, list(pair[::-1])]
    return replace(take, markers=Track(take.markers.names, values))


def mesh_error(rig: BlendshapeRig, solution: Solution, true: Tensor) -> float:
    """Root mean square distance of the solved vertices, as a part of their motion."""
    deltas = rig.deltas.flatten(1)
    return float(((solution.weights - true)[::5] @ deltas).norm() / (true[::5] @ deltas).norm())


_CLEAN: dict[tuple[int, int, int], float] = {}


def clean_error(capture: Capture, which: int, frames: int) -> float:
    """The error of a take without faults, solved once."""
    key = id(capture), which, frames
    if key not in _CLEAN:
        rig, sites, _ = capture
        take, true = recorded(capture, which, frames)
        _CLEAN[key] = mesh_error(rig, solve_markers(rig, sites, take, AS_IN_THE_HOW_TO), true)
    return _CLEAN[key]


def check_exchanged(capture: Capture, pair: tuple[int, int], share: float, which: int, frames: int) -> None:
    rig, sites, _ = capture
    take, true = recorded(capture, which, frames)
    dirty = exchanged(take, pair, frames // 3, frames // 3 + round(share * frames))
    found = solve_markers(rig, sites, dirty, AS_IN_THE_HOW_TO)
    assert mesh_error(rig, found, true) < 1.1 * clean_error(capture, which, frames)
    assert found.alignment.scale == 1.0
    assert found.warnings == ()


def moving(take: Take, turn: float, way: float) -> Take:
    """The take of a head that turns by so many radians either way, and walks so many millimetres."""
    assert take.markers is not None
    values = take.markers.values
    phase = torch.linspace(0, 6.28, len(values))
    turned = rotation_matrix(turn * torch.stack([0.3 * phase.sin(), phase.cos(), 0 * phase], 1))
    middle = values.nanmean((0, 1))
    moved = (values - middle) @ turned.transpose(1, 2) + middle
    moved = moved + way * torch.stack([phase.sin(), 0 * phase, (2 * phase).cos()], 1)[:, None]
    return replace(take, markers=Track(take.markers.names, moved))


def test_shapes_that_markers_hardly_see_are_named(stage: Capture) -> None:
    """Thirty markers, none on a lid: eyes' shapes are named, and their weights are off by nearly all that they are."""
    rig, _, takes = stage
    sites = place_markers(rig, 30)
    take = record(rig, sites, takes[0], torch.Generator().manual_seed(0), StageFlaws(noise=0.3)).take
    solution = solve_markers(rig, sites, take, SolveSettings())
    error, usual = (one.square().mean(0).sqrt() for one in (solution.weights - takes[0], takes[0]))
    moved = usual > 0.1
    named = torch.tensor([name in solution.unseen for name in rig.names])
    assert {"eyeBlinkLeft", "eyeSquintRight"} & set(rig.names) <= set(solution.unseen)
    assert not {"jawOpen", "mouthSmileLeft", "browInnerUp"} & set(solution.unseen)
    assert float((error / usual)[named & moved].median()) > 0.8
    assert float((error / usual)[~named & moved].median()) < 0.5
    line = next(one for one in SolveReport(solution, 1.0, 1.0).lines() if "hardly see" in one)
    assert all(name in line for name in solution.unseen[:3])


@pytest.mark.parametrize(("turn", "way", "free"), [(0.9, 60.0, False), (0.9, 200.0, True), (0.12, 200.0, False)])
def test_a_head_that_moves_freely_in_the_volume_costs_nothing(
    stage: Capture, turn: float, way: float, free: bool
) -> None:
    rig, sites, _ = stage
    take, true = recorded(stage, frames=60)
    freely = moving(take, turn, way)
    found = solve_markers(rig, sites, freely, replace(AS_IN_THE_HOW_TO, free_scale=free))
    assert mesh_error(rig, found, true) < 1.1 * clean_error(stage, 0, 60)
    assert found.warnings == ()


@pytest.mark.parametrize(
    ("given", "missing"),
    [({"slip": False}, "--slip"), ({"align": False}, "--align"), ({"scale": 1e-3}, "--align --slip")],
)
def test_a_head_that_moves_freely_is_refused_with_how_far_and_the_flags_that_are_missing(
    stage: Capture, given: dict[str, float], missing: str
) -> None:
    rig, sites, _ = stage
    freely = moving(recorded(stage, frames=60)[0], 0.7, 500.0)
    if (scale := given.get("scale")) is not None:
        freely = replace(freely, markers=Track(freely.markers.names, scale * freely.markers.values))
        settings, expected = SolveSettings(), f"add --unit m, and {missing}, as the head moves in the volume"
    else:
        settings = replace(AS_IN_THE_HOW_TO, **given)
        expected = rf"the head moves in the volume, by up to \d{{3,4}}\.\d mm and \d+\.\d degrees; .* add {missing};"
    with pytest.raises(AlignmentError, match=expected):
        solve_markers(rig, sites, freely, settings)


def test_a_frame_at_rest_shows_the_scale_of_a_head_that_moves_freely(stage: Capture) -> None:
    rig, sites, (weights,) = stage
    weights = weights.clone()
    weights[7] = 0.0
    take, true = recorded((rig, sites, [weights]), frames=60)
    settings = SolveSettings(neutral=7, clean=True, slip=True)
    steady = solve_markers(rig, sites, take, settings)
    freely = moving(take, 0.9, 500.0)
    found = solve_markers(
        rig, sites, replace(freely, markers=Track(sites.labels, 0.8 * freely.markers.values)), settings
    )
    assert 0.8 * float(found.alignment.scale) == pytest.approx(float(steady.alignment.scale), rel=0.003)
    assert mesh_error(rig, found, true) < 1.1 * mesh_error(rig, steady, true)


def test_wrong_markers_in_a_frame_are_no_motion_of_the_helmet(stage: Capture) -> None:
    rig, sites, _ = stage
    take, _ = recorded(stage, frames=60)
    assert take.markers is not None
    values = take.markers.values.clone()
    values[20, 3] += 3000.0
    values[40, 10:20] = values[40, 5]
    spoiled = replace(take, markers=Track(take.markers.names, values))
    steady, found = (solve_markers(rig, sites, one, AS_IN_THE_HOW_TO).motion for one in (take, spoiled))
    assert steady is not None
    assert found is not None
    assert float((steady.translation - found.translation).norm(dim=1).max()) < 0.5


@pytest.mark.parametrize(
    ("pair", "share"),
    [((0, 30), 0.09), *(pytest.param(*more, marks=BENCH) for more in (((2, 41), 0.3), ((5, 17), 0.02)))],
)
def test_labels_exchanged_in_part_of_the_take_cost_nothing(stage: Capture, pair: tuple[int, int], share: float) -> None:
    check_exchanged(stage, pair, share, 0, 60)


@pytest.mark.bench
@pytest.mark.real
@pytest.mark.parametrize(("pair", "share"), [((1, 57), 0.09), ((20, 83), 0.02)])
def test_labels_exchanged_in_part_of_a_real_take_cost_nothing(
    real_capture: Capture, pair: tuple[int, int], share: float
) -> None:
    check_exchanged(real_capture, pair, share, 0, 300)


@pytest.mark.parametrize(("pair", "neutral"), [((1, 30), None), pytest.param((4, 22), 0, marks=BENCH)])
def test_labels_exchanged_in_the_whole_take_are_warned_of_and_put_back(
    stage: Capture, pair: tuple[int, int], neutral: int | None
) -> None:
    rig, sites, _ = stage
    take, true = recorded(stage, slips=False)
    dirty = exchanged(take, pair, 0, len(take))
    settings = SolveSettings(neutral=neutral, align=neutral is None, free_scale=False, frame_by_frame=True)
    right, warned = (solve_markers(rig, sites, each, settings) for each in (take, dirty))
    (warning,) = (text for text in warned.warnings if "exchanged in the whole take" in text)
    assert all((sites.labels or ())[m] in warning for m in pair)
    assert not any("exchanged" in text for text in right.warnings)
    said, usual = (SolveReport(each, 1.0, 1.0).verdict() for each in (warned, right))
    assert said.startswith("result: partly usable, labels seem to be exchanged, see the warning")
    assert usual.startswith("result: good")
    repaired = solve_markers(rig, sites, dirty, replace(settings, clean=True))
    assert not any("exchanged" in text for text in repaired.warnings)
    assert mesh_error(rig, repaired, true) < 1.1 * mesh_error(rig, right, true)


@pytest.mark.parametrize("pair", [(1, 30), pytest.param((12, 45), marks=BENCH)])
def test_labels_exchanged_in_part_of_a_take_that_is_not_cleaned_are_warned_of(
    stage: Capture, pair: tuple[int, int]
) -> None:
    rig, sites, _ = stage
    take, _ = recorded(stage, slips=False)
    settings = SolveSettings(align=True, free_scale=False, frame_by_frame=True)
    found = solve_markers(rig, sites, exchanged(take, pair, 27, 33), settings)
    first, second = ((sites.labels or ())[m] for m in pair)
    named = f"the labels {first} and {second} are exchanged in about 10 % of the frames (27–32)"
    assert named in found.warnings[0]


def test_a_marker_that_is_elsewhere_in_the_whole_take_is_named(stage: Capture) -> None:
    """What is subtracted at rest would hide it in the distances."""
    rig, sites, _ = stage
    take, _ = recorded(stage, slips=False)
    values = take.markers.values.clone()
    values[:, 4] += torch.tensor([0.0, 9.0, 12.0])
    dirty = replace(take, markers=Track(take.markers.names, values))
    settings = SolveSettings(align=True, free_scale=False, frame_by_frame=True)
    right, warned = (solve_markers(rig, sites, each, settings) for each in (take, dirty))
    assert not any("lie off their sites" in text for text in right.warnings)
    (warning,) = (text for text in warned.warnings if "lie off their sites" in text)
    label, distance = re.search(r"sites: (\S+) (\S+) mm;", warning).groups()
    assert label == take.markers.names[4]
    assert float(distance) == pytest.approx(15.0, abs=4.0)
    assert SolveReport(warned, 1.0, 1.0).verdict().startswith("result: partly usable, 1 marker lies off the site")


def test_neighbours_that_a_marker_far_off_draws_are_not_named() -> None:
    rig = performer(texture=False)
    sites = place_markers(rig, 40)
    weights = rig.weights_from(perform(20, torch.Generator().manual_seed(4)).weights)
    take = record(rig, sites, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.05)).take
    values = take.markers.values.clone()
    values[:, 5, 1] += 60
    _, astray = check_head(rig, sites, replace(take, markers=Track(take.markers.names, values)))
    assert [text.split()[0] for text in astray] == [take.markers.names[5]]


def bent(rig: BlendshapeRig, size: float, seed: int) -> BlendshapeRig:
    """A rig of the same topology and shapes on another head: the rest shape is bent smoothly, by ``size`` mm."""
    generator = torch.Generator().manual_seed(seed)
    centres = rig.vertices[torch.randint(len(rig.vertices), (12,), generator=generator)]
    bumps = torch.exp(-torch.cdist(rig.vertices, centres).square() / (2 * 30.0**2))
    moved = bumps @ torch.randn(12, 3, generator=generator)
    moved = moved * (size / moved.norm(dim=1).square().mean().sqrt())
    return BlendshapeRig(rig.neutral.with_vertices(rig.vertices + moved), rig.deltas, rig.names)


@pytest.mark.parametrize(("size", "seed"), [(2.0, 0), pytest.param(4.0, 1, marks=BENCH)])
def test_another_head_of_the_same_topology_is_refused_or_warned_of(stage: Capture, size: float, seed: int) -> None:
    rig, sites, takes = stage
    other = bent(rig, size, seed)
    settings = SolveSettings(align=True, free_scale=False, frame_by_frame=True)
    take, _ = recorded(stage, slips=False)
    # The attachment and the take are the actor's, the rig is not.
    with pytest.raises(AlignmentError, match=r"made for another head: its sites at rest lie \d.* --insist"):
        solve_markers(other, sites, take, settings)
    # A rig and its attachment, and the take of another actor.
    theirs, _ = recorded((other, sites, takes), slips=False)
    found = solve_markers(rig, replace(sites, rest=None), theirs, settings)
    assert any("smooth over the face" in warning for warning in found.warnings)


@pytest.mark.parametrize(("shape", "level"), [("jawOpen", 0.3), pytest.param("mouthPucker", 0.8, marks=BENCH)])
def test_a_neutral_frame_that_moves_is_warned_of_with_the_calmest_one(shape: str, level: float) -> None:
    rig = performer(texture=False)
    sites = place_markers(rig, 60)
    moving = perform(60, torch.Generator().manual_seed(4)).weights
    weights = 0.3 * rig.weights_from(moving)
    weights[20], weights[40] = 0.0, 0.0
    weights[40, rig.index([shape])] = level
    take, _ = recorded((rig, sites, [weights]), slips=False)
    settings = SolveSettings(free_scale=False, frame_by_frame=True)
    cut = take.frames(slice(5, None))  # frames are named by their numbers in the recording
    calm, restless = (solve_markers(rig, sites, cut, replace(settings, neutral=row)) for row in (15, 35))
    assert not any("not at rest" in warning for warning in calm.warnings)
    (warning,) = (warning for warning in restless.warnings if "frame 40 is not at rest" in warning)
    assert shape in warning

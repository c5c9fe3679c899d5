"""What ``torchface solve`` refuses, and what it only warns of, with the figure and the way out."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import Attachment, BlendshapeRig, Take, Track, load_take, save_rig, save_take
from torchface.capture import HelmetSolver, MarkerSolver
from torchface.errors import ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.synthetic.stages import StageFlaws, place_markers, record
from torchface.workflows.marker_input import scale_warnings
from torchface.workflows.solve.solution import _empty_frame_warnings, _frames
from torchface.workflows.solve.take_check import check_coverage

Solve = Callable[..., str]
FRAMES = 60


@pytest.fixture(scope="module")
def stage(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig, an attachment, and a take that fits them."""
    folder = tmp_path_factory.mktemp("stage")
    sites = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(FRAMES)[:, None] / torch.tensor([7.0, 11, 5, 13]))
    flaws = StageFlaws(noise=0.05, missing=0.05)
    take = record(dome_rig, sites, weights, torch.Generator().manual_seed(0), flaws).take
    save_rig(dome_rig, folder / "rig.glb")
    sites.save(folder / "attachment.json")
    save_take(take, folder / "take.c3d")
    return folder


def changed(stage: Path, name: str, change: Callable[[Tensor], Tensor]) -> Path:
    take = load_take(stage / "take.c3d")
    save_take(Take(take.fps, markers=Track(take.markers.names, change(take.markers.values))), stage / name)
    return stage / name


@pytest.fixture
def solve(stage: Path, messages_of: Solve) -> Solve:
    """Solves a take into ``weights.csv``, and gives what is said."""

    def solved(take: Path, *more: str, attachment: str = "attachment.json", status: int = 0) -> str:
        (stage / "weights.csv").unlink(missing_ok=True)
        words = ("solve", stage / "rig.glb", take, "--attachment", stage / attachment, "--out", stage / "weights.csv")
        return messages_of(*words, "--quiet", *more, status=status)

    return solved


def weights(stage: Path) -> Tensor:
    return load_take(stage / "weights.csv").weights.values


def elsewhere(markers: Tensor) -> Tensor:
    turn = torch.tensor([[math.cos(0.7), -math.sin(0.7), 0], [math.sin(0.7), math.cos(0.7), 0], [0, 0, 1]])
    return Similarity(torch.ones(1), turn[None], torch.tensor([[100.0, -900, 40]])).apply(markers)


def flipped(markers: Tensor) -> Tensor:
    return markers * torch.tensor([-1.0, 1, 1])


def mixed_up(stage: Path) -> str:
    sites = Attachment.load(stage / "attachment.json")
    order = torch.randperm(30, generator=torch.Generator().manual_seed(0))
    replace(sites, triangles=sites.triangles[order], barycentric=sites.barycentric[order]).save(stage / "mixed.json")
    return "mixed.json"


@pytest.mark.parametrize(
    ("change", "attachment", "more", "cause"),
    [
        (elsewhere, False, (), "in another space: add --align"),
        (lambda markers: flipped(elsewhere(markers)), False, (), "the coordinates are left-handed (add --flip x"),
        (lambda markers: markers / 1000, False, (), "seems to be in metres: add --unit m"),
        (lambda markers: markers / 10, False, (), "seems to be in centimetres: add --unit cm"),
        (lambda markers: markers, True, (), "labels are mixed up"),
        (lambda markers: markers, True, ("--align",), "labels are mixed up"),
    ],
)
def test_a_take_that_the_rig_does_not_explain_is_refused_with_the_cause(
    stage: Path,
    change: Callable[[Tensor], Tensor],
    attachment: bool,
    more: tuple[str, ...],
    cause: str,
    solve: Solve,
) -> None:
    take = changed(stage, "bad.c3d", change)
    where = mixed_up(stage) if attachment else "attachment.json"
    printed = solve(take, *more, attachment=where, status=2)
    assert not (stage / "weights.csv").exists()
    assert "bad.c3d" in printed
    assert "mm (median)" in printed
    assert cause in printed
    told = solve(take, *more, "--insist", attachment=where)
    assert (stage / "weights.csv").is_file()
    assert "warning: the rig brings the marker sites no nearer" in told
    assert attachment or "another head's" not in told  # whose cause is named already


def test_a_unit_said_by_hand_gives_the_same_weights(stage: Path, solve: Solve) -> None:
    solve(stage / "take.c3d")
    right = weights(stage)
    solve(changed(stage, "metres.c3d", lambda markers: markers / 1000), "--unit", "m")
    torch.testing.assert_close(weights(stage), right, atol=1e-3, rtol=0)


def test_a_mirrored_take_is_refused_and_flipped_by_hand(stage: Path, solve: Solve) -> None:
    take = changed(stage, "mirrored.c3d", lambda markers: flipped(elsewhere(markers)))
    mirrored = "mirrored.c3d: the markers are a mirror image of their sites: turned, moved and scaled"
    assert mirrored in solve(take, "--align", status=2)
    each = ("--align", "--frame-by-frame")
    solve(stage / "take.c3d", *each)
    right = weights(stage)
    solve(take, *each, "--flip", "y")
    torch.testing.assert_close(weights(stage), right, atol=5e-3, rtol=0)
    printed = solve(stage / "take.c3d", "--align", "--flip", "x", status=2)
    assert "leave out --flip x, or rename the labels" in printed
    assert "negate" not in printed


def aligned_scale(said: str) -> float:
    return float(said.split("alignment: scale ")[1].split(",")[0])


def test_the_scale_is_held_where_the_unit_is_known_and_warned_of(stage: Path, solve: Solve) -> None:
    each = ("--align", "--frame-by-frame")
    for factor, said in ((0.98, "at 1.02"), (0.1, "the take seems to be in cm (--unit cm)")):
        take = changed(stage, "small.c3d", lambda markers, f=factor: f * markers)
        printed = solve(take, *each, "--scale", "free")
        assert said in printed
        assert "held" not in printed
        assert abs(aligned_scale(printed) * factor - 1) < 0.01
    small = changed(stage, "small.c3d", lambda markers: 0.98 * markers)
    printed = solve(small, *each)
    assert "warning: the take fits the rig at 1.02" in printed
    assert "it was held at 1: --scale free" in printed
    assert aligned_scale(printed) == 1.0
    # A CSV has no unit unless one is given.
    table = changed(stage, "small.csv", lambda markers: 0.98 * markers)
    for more, scale in (((), 1 / 0.98), (("--unit", "mm"), 1.0)):
        assert abs(aligned_scale(solve(table, *each, *more)) - scale) < 3e-3
    assert scale_warnings(1.009, held=True) == []


def test_a_take_that_fits_is_good_without_a_warning(stage: Path, solve: Solve) -> None:
    printed = solve(stage / "take.c3d")
    assert printed.startswith("result: good, the markers lie 0.0")
    assert "warning" not in printed


def test_a_spike_in_a_take_that_is_not_cleaned_is_no_good_result(stage: Path, solve: Solve) -> None:
    def spiked(markers: Tensor) -> Tensor:
        markers[20, 3, 1] += 500.0
        return markers

    take = changed(stage, "spiked.c3d", spiked)
    printed = solve(take)
    assert "result: partly usable, single frames are wrong" in printed
    assert "20" in printed.split("mm from the solved face, at worst")[0]
    assert "add --clean" in printed
    assert "warning" not in solve(take, "--clean")


@pytest.mark.parametrize(("noise", "verdict"), [(0.7, "partly usable"), (2.0, "poor")])
def test_markers_that_lie_beside_the_solved_face_are_no_good_result(
    stage: Path, noise: float, verdict: str, solve: Solve
) -> None:
    """Normal noise of s mm a coordinate lies 1.54 s from its site in the median; 0.6 and 1.4 mm are usual, the most."""
    generator = torch.Generator().manual_seed(0)
    printed = solve(changed(stage, "noisy.c3d", lambda x: x + noise * torch.randn(x.shape, generator=generator)))
    assert f"result: {verdict}, the markers lie" in printed
    distance = float(printed.split("the markers lie ")[1].split(" mm")[0])
    assert distance == pytest.approx(1.54 * noise, rel=0.15)


def test_coverage_is_of_the_attachment(stage: Path, solve: Solve) -> None:
    take = load_take(stage / "take.c3d")
    for count, name in ((12, "some.c3d"), (1, "one.c3d")):
        save_take(replace(take, markers=take.markers.select(take.markers.names[:count])), stage / name)
    printed = solve(stage / "some.c3d")
    assert "warning: the take shows 12 of the attachment's 30 markers" in printed
    share = float(torch.isfinite(take.markers.values[:, :12, 0]).double().mean()) * 12 / 30
    assert printed.startswith(f"result: partly usable, {100 * share:.1f} % of the markers' samples were seen")
    assert "found 1 of the attachment's 30 markers" in solve(stage / "one.c3d", status=2)
    assert not (stage / "weights.csv").exists()
    assert "too few for 4 shapes" in solve(stage / "one.c3d", "--insist")


def test_frames_that_show_too_few_markers_are_counted(stage: Path) -> None:
    take = load_take(stage / "take.c3d")
    values = take.markers.values.clone()
    values[10:17, 1:] = torch.nan
    values[10:17, 0] = 0
    poor = Take(60.0, markers=Track(take.markers.names, values))
    assert check_coverage(Attachment.load(stage / "attachment.json"), poor, 4).poor == 7


def test_of_many_stretches_of_frames_the_first_are_named_and_the_others_counted() -> None:
    rows = torch.tensor([10 * stretch + frame for stretch in range(10) for frame in range(3)])
    said = _frames(Take(60.0, markers=Track(("a",), torch.zeros(100, 1, 3))), rows)
    assert said.startswith("30 frames (0–2, 10–12, ")
    assert said.endswith("70–72 and 2 more stretches)")


@pytest.mark.parametrize(("empty", "said"), [([4], "before and after"), ([4, 9], "held at the take's ends")])
def test_of_a_take_that_ends_without_markers_is_said_what_is_held(empty: list[int], said: str) -> None:
    markers = torch.zeros(10, 3, 3)
    markers[empty] = torch.nan
    (warning,) = _empty_frame_warnings(Take(60.0, markers=Track(("a", "b", "c"), markers)))
    assert warning.endswith(said)


@pytest.mark.parametrize("more", [(), ("--frame-by-frame",), ("--frame-by-frame", "--slip", "--clean")])
def test_frames_without_a_marker_are_bridged_and_named(stage: Path, more: tuple[str, ...], solve: Solve) -> None:
    empty = [20, 21, 22, 45]

    def without(markers: Tensor) -> Tensor:
        markers = markers.clone()
        markers[empty] = torch.nan
        return markers

    assert "4 frames (20–22, 45) show no marker" in solve(changed(stage, "empty.c3d", without), *more)
    written = weights(stage)
    solve(stage / "take.c3d", *more)
    assert torch.isfinite(written).all()
    assert float((written - weights(stage))[empty].abs().max()) < 0.1


def test_solvers_put_empty_frames_between_their_neighbours(stage: Path, dome_rig: BlendshapeRig) -> None:
    solver = MarkerSolver(dome_rig, Attachment.load(stage / "attachment.json"))
    take = load_take(stage / "take.c3d")
    values = take.markers.values.clone()
    values[[0, 50, 51, 52]] = torch.nan
    gapped = Take(60.0, markers=Track(take.markers.names, values))
    full, bridged = solver.solve_take(take).weights, solver.solve_take(gapped).weights
    kept = [i for i in range(FRAMES) if i not in (0, 50, 51, 52)]
    torch.testing.assert_close(bridged.values[kept], full.values[kept], atol=1e-4, rtol=0)
    torch.testing.assert_close(bridged.values[0], bridged.values[1])
    torch.testing.assert_close(bridged.values[51], (bridged.values[49] + bridged.values[53]) / 2)
    _, motion = HelmetSolver(dome_rig, Attachment.load(stage / "attachment.json")).solve_take(gapped)
    assert torch.equal(motion.translation[50], motion.translation[49])
    assert torch.equal(motion.rotation[0], motion.rotation[1])
    with pytest.raises(ValueRangeError, match=f"none in any of {FRAMES} frames"):
        solver.solve_take(Take(60.0, markers=Track(take.markers.names, torch.full_like(values, torch.nan))))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("zeros.c3d", lambda markers: 0 * markers),
        ("one_spot.c3d", lambda markers: 0 * markers + 7),
        ("line.c3d", lambda markers: 0 * markers + torch.linspace(1, 50, markers.shape[1])[:, None]),
    ],
)
@pytest.mark.parametrize("more", [(), ("--align",), ("--neutral", "0"), ("--slip", "--clean")])
def test_markers_without_a_shape_are_an_error(
    stage: Path, name: str, change: Callable[[Tensor], Tensor], more: tuple[str, ...], solve: Solve
) -> None:
    assert name in solve(changed(stage, name, change), *more, status=2)
    assert not (stage / "weights.csv").exists()

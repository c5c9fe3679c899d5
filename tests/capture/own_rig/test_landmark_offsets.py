"""Fixed offsets between rig and finder are found and kept in a file; expressions that never end are no offsets."""

import functools
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.capture import ShapePrior, VideoSolver, WeightReadings
from torchface.capture.own_rig import FaceMeasurements, VideoSettings
from torchface.capture.own_rig.face_points import FacePoints
from torchface.capture.own_rig.landmark_offset_estimate import estimate_offsets
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets, shifted_points
from torchface.errors import FileFormatError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import similarity_transform
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)
FRAMES = 20
SMILE = ("mouthSmileLeft", "mouthSmileRight")
CRYING = {"browDown": 0.8, "eyeBlink": 0.9, "mouthFrown": 0.7, "mouthUpperUp": 0.5}


@functools.cache
def person(seed: int | None = None) -> BlendshapeRig:
    identity = None if seed is None else torch.randn(39, generator=torch.Generator().manual_seed(seed))
    return performer(identity, texture=False)


def prior() -> ShapePrior:
    learned = zoo.get_model("shape_prior").renamed(person().names)
    lids = torch.tensor(
        [0.5 if name.startswith(("eyeBlink", "eyeWide", "eyeSquint")) else 0.0 for name in person().names]
    )
    return learned.widened(lids.square())


def solver_of(rig: BlendshapeRig) -> VideoSolver:
    return VideoSolver(rig, None, K, prior(), settings=VideoSettings.of_found_landmarks())


def talking(constant: dict[str, float]) -> Tensor:
    """A take with speech, blinks and brows over expressions that never end, (T,N)."""
    at = torch.linspace(0, 1, FRAMES, dtype=torch.float64)
    weights = torch.zeros(FRAMES, len(person().names), dtype=torch.float64)
    moving = {"jawOpen": 0.2 * (1 + torch.sin(20 * at)), "browInnerUp": 0.3 * torch.sin(6 * at).clamp(min=0)}
    moving |= {f"eyeBlink{side}": (torch.sin(9 * at) > 0.95).double() for side in ("Left", "Right")}
    for name, curve in moving.items():
        weights[:, person().names.index(name)] = curve
    for name, size in constant.items():
        weights[:, person().names.index(name)] = size
    return weights


def seen(rig: BlendshapeRig, weights: Tensor, offsets: Tensor | None = None) -> Tensor:
    """Landmarks (T,68,2) of a head that turns, half a pixel of noise."""
    at = torch.linspace(0, 1, len(weights), dtype=torch.float64)[:, None]
    turn = torch.cat([0.15 * torch.sin(5 * at), 0.3 * torch.cos(4 * at), 0.05 * at], dim=1)
    rotation = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)) @ rotation_matrix(turn)
    translation = torch.cat([10 * at, -5 * at, 480 + 10 * at], dim=1)
    points = FacePoints.of(rig, rig.neutral.landmarks)
    if offsets is not None:
        points = shifted_points(points, rig.names, offsets)
    rows = points.chosen(weights, rotation, translation, K)
    placed = points.at(weights)[torch.arange(len(rows))[:, None], rows]
    image = (placed @ rotation.mT + translation[:, None]) @ K.T
    noise = torch.randn(len(weights), 68, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return image[..., :2] / image[..., 2:] + 0.5 * noise


def planted_offsets() -> Tensor:
    return 2.0 * torch.randn(68, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_a_smile_that_never_ends_is_no_offset(size: float) -> None:
    """Where rig and finder agree next to nothing is taken for an offset; where they do not, the smile stays a smile."""
    weights = talking(dict.fromkeys(SMILE, 0.6))
    landmarks = seen(person(), weights, size * planted_offsets())
    solver = solver_of(person())
    offsets = estimate_offsets(solver, landmarks)
    before, after = solver(landmarks), solver.shifted(offsets)(landmarks)
    errors = [float((solution.weights - weights).abs().mean()) for solution in (before, after)]
    assert errors[1] < 1.1 * errors[0]
    rows = [person().names.index(name) for name in SMILE]
    kept = [float(solution.weights[:, rows].mean()) for solution in (before, after)]
    assert kept[1] > (0.9 if size == 0 else 0.8) * kept[0]
    if size == 0:
        assert float(offsets.millimetres.norm(dim=1).mean()) < 0.2
    else:
        assert float(after.errors.mean()) < 0.5 * float(before.errors.mean())


def test_lids_shut_whatever_the_offsets() -> None:
    """The rig's lids are open further than the person's; both shut alike."""
    points = FacePoints.of(person(), person().neutral.landmarks)
    apart = torch.zeros(68, 3, dtype=torch.float64)
    apart[[37, 38, 43, 44], 1], apart[[40, 41, 46, 47], 1] = -1.5, 1.5
    shut = talking({"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0})[:1]
    moved = shifted_points(points, person().names, apart)
    still = moved.at(shut)[0, :68] - points.at(shut)[0, :68]
    assert float(still.abs().max()) < 1e-9
    torch.testing.assert_close(moved.rest[:68], points.rest[:68] + apart)


def test_the_file_gives_the_same_and_other_rigs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "landmark_offsets.json"
    offsets = LandmarkOffsets(planted_offsets(), 0.0123456, "a rig", "a finder").rounded()
    offsets.save(path)
    found = LandmarkOffsets.load(path)
    assert torch.equal(found.millimetres, offsets.millimetres)
    assert (found.noise, found.rig, found.finder) == (offsets.noise, "a rig", "a finder")
    found.require("a rig", "a finder")
    with pytest.raises(ValueRangeError, match="estimated with another finder"):
        found.require("a rig", "another")
    path.write_text(
        '{"format": "torchface.landmark-offsets/1", "noise": 0.01, "rig": "", "finder": "", "offsets": [[1]]}'
    )
    with pytest.raises(FileFormatError, match="offsets"):
        LandmarkOffsets.load(path)
    path.write_text('{"weights": []}')
    with pytest.raises(FileFormatError, match="landmark offsets as torchface track writes them"):
        LandmarkOffsets.load(path)


def test_too_few_frames_tell_no_offsets() -> None:
    landmarks = seen(person(), talking({}))
    landmarks[9:] = torch.nan
    assert estimate_offsets(solver_of(person()), landmarks) is None


def modes() -> Tensor:
    return zoo.get_model("head").shape.modes[:, zoo.get_model("head").landmarks].detach()


@pytest.mark.parametrize("neutral", [None, 3])
def test_a_laugh_of_most_of_the_take_is_no_offset(neutral: int | None) -> None:
    """Of a stranger who rests for a sixth of a take and laughs, rest is at rest and the laugh as large as it was."""
    laugh = dict.fromkeys(SMILE, 0.8) | {"jawOpen": 0.5}
    laughing = torch.zeros(5 * FRAMES, len(person().names), dtype=torch.float64)
    for name, size in laugh.items():
        laughing[:, person().names.index(name)] = size * torch.linspace(0.7, 1.0, len(laughing)).double()
    rest = torch.zeros(FRAMES, len(person().names), dtype=torch.float64)
    weights = torch.cat([rest, laughing])
    landmarks = seen(person(5), weights, 0.5 * planted_offsets())
    solver = solver_of(person())
    offsets = estimate_offsets(solver, landmarks, identity_modes=modes(), neutral=neutral)
    found = solver.shifted(offsets)(landmarks[::4]).weights
    for names in (SMILE, ("jawOpen",)):
        rows = [person().names.index(name) for name in names]
        true, solved = weights[::4, rows].mean(1), found[:, rows].mean(1)
        assert 0.75 < float(solved[10:].mean() / true[10:].mean()) < 1.25
        assert float(solved[1:5].max()) < 0.15


def test_a_neutral_frame_must_show_the_face() -> None:
    landmarks = seen(person(), talking({}))
    with pytest.raises(ValueRangeError, match="neutral frame 20: found 20 frames"):
        estimate_offsets(solver_of(person()), landmarks, neutral=20)
    landmarks[4] = torch.nan
    with pytest.raises(ValueRangeError, match="neutral frame 4: found no face in it"):
        estimate_offsets(solver_of(person()), landmarks, neutral=4)


def test_crying_is_crying_on_another_head() -> None:
    """Furrowed brows, shut eyes and mouth corners drawn down, seen with offsets on one head and solved on another."""
    constant = {name + side: size for name, size in CRYING.items() for side in ("Left", "Right")}
    rest, crying = talking({}), talking(constant)
    crying[:, person().names.index("browInnerUp")] = 0
    weights = torch.cat([rest, crying])
    landmarks = seen(person(3), weights, 0.5 * planted_offsets())
    solver = solver_of(person())
    offsets = estimate_offsets(solver, landmarks)
    found = solver.shifted(offsets)(landmarks).weights[FRAMES + 3 :].mean(0)

    def mean(name: str) -> float:
        rows = [i for i, known in enumerate(person().names) if known.startswith(name)]
        return float(found[rows].mean())

    assert mean("browDown") > 0.12
    assert mean("browDown") > 1.5 * max(mean("browInnerUp"), mean("browOuterUp"))
    assert mean("eyeBlink") > 0.6
    assert mean("eyeWide") < 0.1
    assert mean("mouthFrown") > 2 * mean("mouthSmile")


def test_hidden_shapes_keep_their_weights_then_rest() -> None:
    weights = talking(dict.fromkeys(SMILE, 0.6)).repeat(3, 1)
    landmarks = seen(person(), weights)
    confidence = torch.ones(len(weights), 68)
    confidence[20:, 48:] = 0  # a hand before the mouth
    solution = solver_of(person())(landmarks, confidence=confidence)
    smile = solution.weights[:, [person().names.index(name) for name in SMILE]].mean(1)
    assert float(smile[19]) > 0.3
    assert float(smile[26]) > 0.7 * float(smile[19])  # a fifth of a second later
    assert float(smile[59]) < 0.25 * float(smile[19])
    told = solution.confidence
    rows = [person().names.index(name) for name in (*SMILE, "browDownLeft")]
    assert bool((told[:20, rows] > 0.99).all())
    assert bool((told[20:, rows[:2]] < 0.25).all())
    assert bool((told[20:, rows[2]] > 0.99).all())


def test_a_hidden_side_follows_the_other_one() -> None:
    """Half a face behind a hand blinks, and smiles, with the half that is seen, a frame later."""
    names = person().names
    weights, blinks = talking(dict.fromkeys(SMILE, 0.6)), [names.index(f"eyeBlink{side}") for side in ("Left", "Right")]
    weights[:, blinks] = 0.0
    weights[10:14, blinks] = 0.9
    landmarks, confidence = seen(person(), weights), torch.ones(FRAMES, 68)
    confidence[4:, [*range(22, 27), *range(42, 48), *range(52, 57), *range(63, 66)]] = 0
    found = solver_of(person())(landmarks, confidence=confidence).weights
    blink = found[:, blinks[0]]
    assert float(blink[4:10].max()) < 0.1
    assert float(blink[10:15].max()) > 0.8 * float(found[10:15, blinks[1]].max()) > 0.4
    assert float(blink[18:].max()) < 0.1
    smile = found[12:, [names.index(name) for name in SMILE]]
    assert float((smile[:, 0] - smile[:, 1]).abs().max()) < 0.1
    assert float(smile.min()) > 0.3


def test_frames_left_out_change_little() -> None:
    """The same second at half the rate, or with every third frame lost, gives the same weights at the same times."""
    weights = talking(dict.fromkeys(SMILE, 0.5))
    landmarks, seconds = seen(person(), weights), torch.arange(FRAMES) / 30
    solver = solver_of(person())
    whole = solver(landmarks, seconds=seconds).weights
    for kept in (torch.arange(0, FRAMES, 2), torch.arange(FRAMES)[torch.arange(FRAMES) % 3 < 2]):
        some = solver(landmarks[kept], seconds=seconds[kept]).weights
        assert float((some - whole[kept])[3:].abs().mean()) < 0.01
    with pytest.raises(ValueRangeError, match="times that rise"):
        solver(landmarks[:3], seconds=torch.tensor([0.0, 0.1, 0.1]))


def test_what_was_read_of_an_expression_that_never_ends_is_no_offset() -> None:
    """Half a smile and half a frown of the brows for a whole take, never at rest, which look like a wide mouth."""
    constant = {**dict.fromkeys(SMILE, 0.5), "browDownLeft": 0.5, "browDownRight": 0.5}
    weights, truth = talking(constant), planted_offsets()
    landmarks, solver = seen(person(), weights, truth), solver_of(person())
    read = WeightReadings(torch.eye(weights.shape[1]).double(), weights + 0.05, torch.full_like(weights, 0.15))
    found = {way: estimate_offsets(solver, landmarks, read=given) for way, given in (("read", read), ("guessed", None))}
    off = {}
    for way, offsets in found.items():
        solved = solver.shifted(offsets)(landmarks, measured=FaceMeasurements(weights=read)).weights
        rows = [person().names.index(name) for name in constant]
        off[way] = float((solved - weights)[:, rows].mean(0).abs().mean())
    assert off["read"] < 0.03
    assert off["read"] < 0.7 * off["guessed"]


@pytest.mark.parametrize("seed", [1, 4])
def test_offsets_do_not_move_the_head(seed: int) -> None:
    """Small people, whose features the modes take for a smaller head, are found where they are, by their own size."""
    weights, at = talking({}), torch.linspace(0, 1, FRAMES)
    landmarks, solver = seen(person(seed), weights), solver_of(person())
    offsets = estimate_offsets(solver, landmarks, identity_modes=modes())
    depth = solver.shifted(offsets)(landmarks).translation[:, 2]
    mine, rig = (head.vertices[head.neutral.landmarks].double() for head in (person(seed), person()))
    size = float(similarity_transform(rig[None], mine[None]).scale)
    assert float((depth / (480 + 10 * at)).mean()) * size == pytest.approx(1, abs=0.03)

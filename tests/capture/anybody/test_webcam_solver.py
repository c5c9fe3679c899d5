"""The webcam's solver on planted people: landmarks of heads that it has never seen, with a finder's habits."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.capture.anybody import WebcamControls, WebcamSettings, WebcamSolver, WebcamState
from torchface.errors import ArgumentTypeError, ShapeError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.landmarks.images.face_reading import READ_FOR_SOLVER, FaceReading
from torchface.shape_names import ARKIT
from torchface.synthetic import performer

FPS = 15.0
FOCAL = 554.256
UPRIGHT = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
NAN = torch.full((2,), torch.nan)
NO_FACE = FaceReading(
    torch.full((68, 2), torch.nan), torch.zeros(68), torch.zeros(68), torch.zeros(()), NAN.repeat(2, 1), NAN, NAN, NAN
)


@pytest.fixture(scope="module")
def solver() -> WebcamSolver:
    heads = zoo.get_model("head")
    settings = WebcamSettings(learning=4.0)
    return WebcamSolver(performer(texture=False), heads.shape.modes[:, heads.landmarks], settings=settings)


@pytest.fixture(scope="module")
def person(solver: WebcamSolver) -> Tensor:
    """Coefficients of somebody."""
    return 0.8 * torch.randn(solver.settings.coefficients, generator=torch.Generator().manual_seed(4)).double()


def weights_of(**weights: float) -> Tensor:
    made = torch.zeros(len(ARKIT), dtype=torch.float64)
    for name, value in weights.items():
        made[ARKIT.index(name)] = value
    return made


def seen(solver: WebcamSolver, person: Tensor, weights: Tensor, turn: tuple[float, float, float]) -> FaceReading:
    """Exact landmarks of a person, iris and openness unknown; which points the contour is follows the pose."""
    points = solver.person.points(person)
    own = (weights @ solver.to_arkit)[None]
    rotation = (UPRIGHT @ rotation_matrix(torch.tensor(turn, dtype=torch.float64)))[None]
    translation = torch.tensor([[10.0, 30.0, 620.0]], dtype=torch.float64)
    rows = points.chosen(own, rotation, translation, torch.eye(3, dtype=torch.float64))
    placed = points.at(own)[0, rows[0]] @ rotation[0].T + translation
    pixels = placed[:, :2] / placed[:, 2:] * FOCAL + torch.tensor([319.5, 239.5])
    eyes = torch.full((2,), torch.nan)
    return FaceReading(
        pixels.float(), torch.zeros(68), torch.ones(68), torch.ones(()), NAN.repeat(2, 1), eyes, eyes, torch.ones(2)
    )


def turns(frames: int) -> list[tuple[float, float, float]]:
    at = torch.arange(frames) / FPS
    return list(
        zip((0.1 * torch.sin(2 * at)).tolist(), (0.35 * torch.sin(3 * at)).tolist(), [0.0] * frames, strict=True)
    )


@pytest.fixture(scope="module")
def known(solver: WebcamSolver, person: Tensor) -> WebcamState:
    """After somebody at rest has turned the head for four seconds."""
    state = solver.start()
    for turn in turns(66):
        state = solver.step(state, seen(solver, person, weights_of(), turn), 1 / FPS)
    return state


def test_a_planted_person_comes_back(solver: WebcamSolver, person: Tensor, known: WebcamState) -> None:
    """In the picture's plane, where a webcam sees; beside what a pose explains."""
    planted, found = (solver.person.points(p.double()).rest[17:68, :2] for p in (person, known.person))
    mean = solver.person.points(torch.zeros_like(person)).rest[17:68, :2]
    before, after = ((x - planted - (x - planted).mean(0)).square().sum(1).mean().sqrt() for x in (mean, found))
    assert float(before) > 2.5
    assert float(after) < 0.8
    assert float(known.calibrated) == 1.0


def test_another_persons_face_at_rest_stays_at_rest(solver: WebcamSolver, person: Tensor, known: WebcamState) -> None:
    assert float(known.weights.max()) < 0.05
    state = solver.start()
    for turn in turns(8):
        state = solver.step(state, seen(solver, person, weights_of(), turn), 1 / FPS)
    assert float(state.weights.max()) < 0.3
    assert float(state.tracked) == 1.0


def test_expressions_of_a_known_person_come_back(solver: WebcamSolver, person: Tensor, known: WebcamState) -> None:
    planted = weights_of(jawOpen=0.5, browInnerUp=0.6, browOuterUpLeft=0.5, browOuterUpRight=0.5)
    state = known
    for turn in turns(5):
        state = solver.step(state, seen(solver, person, planted, turn), 1 / FPS, WebcamControls(smoothing=0.0))
    for name in ("jawOpen", "browInnerUp", "browOuterUpLeft"):
        row = ARKIT.index(name)
        assert float((state.weights[row] - planted[row]).abs()) < 0.1, name


def test_what_is_known_is_frozen_kept_and_forgotten(solver: WebcamSolver, person: Tensor, known: WebcamState) -> None:
    """After its time it is held; ``freeze`` holds it at once; ``reset`` forgets it."""
    after = solver.step(known, seen(solver, person, weights_of(mouthSmileLeft=1.0), (0, 0, 0)), 1 / FPS)
    torch.testing.assert_close(after.person, known.person, rtol=0, atol=0)
    half = replace(known, learned=torch.tensor(2.0))
    frozen = solver.step(half, seen(solver, person, weights_of(), (0, 0, 0)), 1 / FPS, WebcamControls(freeze=True))
    torch.testing.assert_close(frozen.person, known.person, rtol=0, atol=0)
    assert float((solver.step(half, NO_FACE, 1 / FPS).person - known.person).abs().max()) == 0.0
    forgotten = solver.step(known, NO_FACE, 1 / FPS, WebcamControls(reset=True))
    torch.testing.assert_close(forgotten.pack(), solver.start().pack())


def test_a_lost_face_is_held_and_then_at_rest_within_half_a_second(
    solver: WebcamSolver, person: Tensor, known: WebcamState
) -> None:
    state = known
    for turn in turns(3):
        state = solver.step(state, seen(solver, person, weights_of(jawOpen=0.8), turn), 1 / FPS)
    shown, row, curve = state, ARKIT.index("jawOpen"), []
    for _ in range(20):
        state = solver.step(state, NO_FACE, 0.05)
        curve.append(float(state.weights[row]))
        assert float(state.tracked) == 0.0
    assert curve[5] == pytest.approx(float(shown.weights[row]))  # 0.3 s
    assert 0 < curve[10] < curve[5]
    assert max(curve[16:]) == 0.0  # 0.85 s
    torch.testing.assert_close(state.rotation, shown.rotation)
    again = solver.step(state, seen(solver, person, weights_of(), (0, 0, 0)), 0.05)
    assert float(again.tracked) == 1.0


def test_hidden_landmarks_and_a_picture_of_another_size(
    solver: WebcamSolver, person: Tensor, known: WebcamState
) -> None:
    """Half a face without landmarks is solved; a camera that sends twice the pixels shows the same head."""
    reading = seen(solver, person, weights_of(), (0, 0, 0))
    marks = reading.landmarks.clone()
    marks[48:] = torch.nan
    state = solver.step(known, replace(reading, landmarks=marks), 1 / FPS)
    assert bool(torch.isfinite(state.pack()).all())
    assert float(state.weights.max()) < 0.1
    plain = solver.step(known, reading, 1 / FPS)
    large = replace(reading, landmarks=2 * reading.landmarks + 0.5)
    bigger = solver.step(known, large, 1 / FPS, size=(1280, 960))
    torch.testing.assert_close(bigger.weights, plain.weights, atol=2e-3, rtol=0)
    torch.testing.assert_close(bigger.translation, plain.translation, atol=0.5, rtol=0)


def test_a_guess_of_a_hidden_mouth_counts_little(solver: WebcamSolver, person: Tensor, known: WebcamState) -> None:
    """A network that reads a smile behind a hand moves next to nothing; of a mouth that is seen it is believed."""
    names = ("mouthSmileLeft", "mouthSmileRight")
    guess = {"expression": weights_of(**dict.fromkeys(names, 0.5)), "expression_deviation": torch.full((52,), 0.1)}
    smiles = []
    for visibility in (0.0, 1.0):
        state, visible = known, torch.ones(68)
        visible[48:] = visibility
        for _ in range(8):
            reading = seen(solver, person, weights_of(), (0, 0, 0))
            state = solver.step(state, replace(reading, visibility=visible, **guess), 1 / FPS)
        smiles.append(float(state.weights[[ARKIT.index(name) for name in names]].mean()))
    assert smiles[0] < 0.1 * smiles[1]


def test_a_state_packs_into_one_vector(solver: WebcamSolver, known: WebcamState) -> None:
    vector = known.pack()
    assert vector.shape == (solver.layout.length,)
    torch.testing.assert_close(solver.layout.unpack(vector).pack(), vector, rtol=0, atol=0)
    torch.testing.assert_close(solver.layout.unpack(vector).person, known.person, rtol=0, atol=0)
    with pytest.raises(ShapeError, match="webcam state"):
        solver.layout.unpack(vector[1:])
    with pytest.raises(ValueRangeError, match="pose"):
        WebcamControls(pose=7)


def test_an_eye_that_shuts_blinks_and_one_that_looks_down_does_not(solver: WebcamSolver, person: Tensor) -> None:
    """Openness counts beside the person's own, whatever the rig's eyes are like."""
    state, blink = solver.start(), ARKIT.index("eyeBlinkLeft")

    def stepped(state: WebcamState, openness: float, closed: float, **weights: float) -> WebcamState:
        reading = seen(solver, person, weights_of(**weights), (0, 0, 0))
        eyes = {"openness": torch.full((2,), openness), "closed": torch.full((2,), closed)}
        return solver.step(state, replace(reading, **eyes), 1 / 30)

    for _ in range(30):
        state = stepped(state, 0.22, 0.02)
    assert float(state.weights[blink]) < 0.15
    narrow = solver.start()
    for _ in range(60):
        narrow = stepped(narrow, 0.14, 0.02)
    assert float(narrow.weights[blink]) < 0.35
    shut = stepped(stepped(state, 0.12, 0.6), 0.06, 0.99)
    assert float(shut.weights[blink]) > 0.6
    down = stepped(stepped(state, 0.16, 0.05, eyeLookDownLeft=0.8), 0.15, 0.05, eyeLookDownLeft=0.8)
    assert float(down.weights[blink]) < 0.5


def test_a_guided_calibration_finds_how_far_landmarks_go(
    solver: WebcamSolver, person: Tensor, known: WebcamState
) -> None:
    """Somebody whose widest smile goes seven tenths of the rig's way, and who has been asked to smile, smiles fully."""
    half, asked = 0.7, WebcamControls(pose=3, smoothing=0.0)
    smile = seen(solver, person, weights_of(mouthSmileLeft=half, mouthSmileRight=half), (0, 0, 0))
    plain = known
    for _ in range(5):
        plain = solver.step(plain, smile, 1 / FPS, WebcamControls(smoothing=0.0))
    state = known
    for _ in range(45):
        state = solver.step(state, smile, 1 / FPS, asked)
    rows = [ARKIT.index("mouthSmileLeft"), ARKIT.index("mouthSmileRight")]
    assert float(plain.weights[rows].mean()) == pytest.approx(half, abs=0.15)
    assert float(state.gains[1].exp()) == pytest.approx(half, abs=0.15)
    assert float(state.weights[rows].mean()) > 0.9
    assert float(state.gains[[0, 2]].abs().max()) < 0.02


def solved(solver: WebcamSolver, reading: FaceReading, frames: int = 8) -> Tensor:
    state = solver.start()
    for _ in range(frames):
        state = solver.step(state, reading, 1 / FPS)
    return state.shapes.double() @ solver.to_arkit.T


def test_an_expression_that_is_read_decides_what_is_not_seen(solver: WebcamSolver) -> None:
    puff, nobody = ARKIT.index("cheekPuff"), torch.zeros(solver.settings.coefficients).double()
    unknown, sure = torch.full((52,), torch.inf), torch.full((52,), torch.inf)
    sure[puff] = 0.002
    read = replace(seen(solver, nobody, weights_of(), (0.05, 0.2, 0.0)), expression=weights_of(cheekPuff=0.5).float())
    assert float(solved(solver, replace(read, expression_deviation=sure))[puff]) > 0.3
    assert float(solved(solver, replace(read, expression_deviation=unknown))[puff]) < 0.15


def test_a_smile_that_is_read_and_never_ends_is_not_the_persons_face(solver: WebcamSolver, person: Tensor) -> None:
    smile = weights_of(mouthSmileLeft=0.5, mouthSmileRight=0.5)
    state, deviation = solver.start(), torch.full((52,), 0.2)
    for turn in turns(66):
        reading = seen(solver, person, smile, turn)
        state = solver.step(state, replace(reading, expression=smile.float(), expression_deviation=deviation), 1 / FPS)
    rows = [ARKIT.index(name) for name in ("mouthSmileLeft", "mouthSmileRight")]
    assert float(state.weights[rows].min()) > 0.47


def test_antagonists_are_never_on_together(solver: WebcamSolver, person: Tensor) -> None:
    state, pairs, nobody = solver.start(), solver.arkit_signed, torch.zeros_like(person)
    for frame in range(12):
        mouth = {"mouthLeft" if frame < 6 else "mouthRight": 0.6}
        weights = weights_of(**mouth, **{"mouthSmileLeft" if frame % 4 < 2 else "mouthFrownLeft": 0.5})
        state = solver.step(state, seen(solver, nobody, weights, (0.05, 0.2, 0.0)), 1 / FPS)
        first, second = state.weights.double() @ pairs.T.clamp(min=0), state.weights.double() @ (-pairs.T).clamp(min=0)
        assert float(torch.minimum(first, second).max()) < 1e-6
    assert float(state.weights[ARKIT.index("mouthRight")]) > 0.2


def test_what_is_infinite_is_what_nobody_saw(solver: WebcamSolver, person: Tensor) -> None:
    shown = seen(solver, person, weights_of(jawOpen=0.5), (0.0, 0.0, 0.0))
    both = []
    for unknown in (torch.nan, torch.inf):
        marks, nothing = shown.landmarks.clone(), torch.full((2,), unknown)
        marks[30, 0] = unknown
        given = replace(shown, landmarks=marks, iris=nothing.repeat(2, 1), openness=nothing, closed=nothing)
        both.append(solver.step(solver.start(), given, 1 / FPS).pack())
    assert bool(both[1].isfinite().all())
    assert torch.equal(*both)


def test_landmarks_in_one_place_or_on_a_line_are_no_face(solver: WebcamSolver, person: Tensor) -> None:
    shown = seen(solver, person, weights_of(jawOpen=0.5), (0.0, 0.0, 0.0))
    line = torch.stack([torch.arange(68.0), torch.arange(68.0) / 3 + 50], 1)
    before = solver.step(solver.start(), shown, 1 / FPS)
    lost = solver.step(before, NO_FACE, 1 / FPS).pack()
    for marks in (torch.zeros(68, 2), torch.full((68, 2), 123.4), line):
        assert torch.equal(solver.step(before, replace(shown, landmarks=marks), 1 / FPS).pack(), lost)


def test_inputs_of_another_kind_or_shape_are_refused(solver: WebcamSolver) -> None:
    reading = [getattr(NO_FACE, name) for name in READ_FOR_SOLVER]
    rest = [torch.tensor([640.0, 480.0]), torch.tensor(0.1), WebcamControls().tensor(), solver.start().pack()]
    assert bool(solver(*reading, *rest).isfinite().all())
    with pytest.raises(ArgumentTypeError, match=r"landmarks: found a list of list, expected a Tensor"):
        solver(reading[0].tolist(), *reading[1:], *rest)
    for row in range(13):
        given = [*reading, *rest]
        given[row] = given[row][..., :-1] if given[row].ndim else given[row][None]
        with pytest.raises(ShapeError, match=r"webcam solver: found \w+ \([\d, ]+\), expected \([\d, ]*\)"):
            solver(*given)

"""The page's own modules under Node: names, calibration, settings, times."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchface.errors import ValueRangeError
from torchface.shape_names import ARKIT, VRM1, arkit_names, mapping, vowel_sources
from torchface.workflows.live.live_frames import LiveFrame
from torchface.workflows.live.weight_controls import WeightControls, read_weight_settings

pytestmark = pytest.mark.browser
Run = Callable[[str, object], Any]


def test_names_are_taken_as_torchface_takes_them(run: Run) -> None:
    names = [*ARKIT, "EyeBlinkLeft", "eyeBlink_L", "browInnerUp_L", "browInnerUp_R", "cheekPuff_R", "mouthSmile"]
    names += ["eyeBlink", "jawOpenLeft", "antenna", "tongueout", "jaw", "left", "_L"]
    told = run("names", names)
    assert tuple(told["arkit"]) == ARKIT
    found = torch.zeros(len(names), len(ARKIT))
    for row, sources in enumerate(told["sources"]):
        for column, factor in sources:
            found[row, column] = factor
    torch.testing.assert_close(found, mapping(ARKIT, names))


def test_names_of_other_programs_are_recognised_by_the_same_tables(run: Run) -> None:
    names = [
        "Fcl_EYE_Close_L",
        "A25_Jaw_Open",
        "facs_bs_MouthSmileLeft_div2",
        "Eye_R_Look_L",
        "browInnerUp_L",
        "Fcl_Joy",
    ]
    names += [
        "head_lod0_mesh__eyes_blink",
        "BrowRaiseInnerL",
        "mixamorig:jawOpen.001",
        "LipCornerPullerR",
        "V_Open",
        "lf_mouth_smile",
        "AU26_jawDrop",
        "jawOpen.001",
        "Face.M_F00_Fcl_MTH_A",
        "vrc.v_ou",
        "vrc.v_pp",
        "Fcl_BRW_Angry",
        "",
    ]
    answer = run("tables", names)
    table: dict[str, list[str]] = {}
    for words, arkit in arkit_names._table().items():
        table.setdefault(arkit, []).append(" ".join(words))
    assert answer["RECOGNISED"] == table
    assert answer["names"] == [arkit_names.arkit_name(name) for name in names]
    for name, rule in zip(names, answer["rules"], strict=True):
        assert {ARKIT[row]: factor for row, factor in rule} == pytest.approx(vowel_sources(name), abs=1e-5)
    assert answer["VRM_POSES"] == VRM1.poses
    assert answer["VRM_BOTH"] == {whole: list(two) for whole, two in VRM1.both.items()}


def test_expressions_of_a_vrm_animation_are_those_that_vmc_sends(run: Run) -> None:
    weights = torch.rand(5, 52, generator=torch.Generator().manual_seed(0)) * 0.7
    found = run("expressions", weights.tolist())
    expected = VRM1.from_arkit(weights)
    for row, one in zip(expected, found, strict=True):
        np.testing.assert_allclose([one[name] for name in VRM1.names], row, atol=1e-4)


def test_several_people_are_said_and_which_one_is_followed(run: Run) -> None:
    def frame(left: float, right: float, learned: float = 1.0) -> dict[str, object]:
        return {"presence": 1, "beside": [left, right], "calibrated": learned}

    assert run(
        "words",
        [
            [frame(0, 0, 0.5), True],
            [frame(0.61, 0), True],
            [frame(0.7, 0), False],
            [frame(0.7, 0, 0.5), True],  # in a mirror
            [frame(1, 0.9), False],
            [frame(0, 3), False],
        ],
    ) == [
        "Learning your face: 50 %.",
        "Your face is followed.",
        "Two people: following the right one.",
        "Two people: following the left one.",
        "Three people: following the middle one.",
        "Four people: following the left one.",
    ]


POSES = (
    {"jawOpen": 0.7},
    {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.5},
    {"browInnerUp": 0.6},
    {"eyeBlinkLeft": 0.8, "eyeBlinkRight": 0.8},
    {"mouthPucker": 0.5},
)


def performed(*parts: tuple[float, dict[str, float]]) -> list[tuple[float, bool, dict[str, float]]]:
    """Frames of parts of so many seconds each."""
    frames: list[tuple[float, bool, dict[str, float]]] = []
    for seconds, shown in parts:
        frames += [(1000 * (len(frames) + i) / 30, True, shown) for i in range(round(30 * seconds))]
    return frames


def test_a_calibration_takes_the_poses_that_are_shown(run: Run) -> None:
    told = run("calibration", performed((3.1, {}), *((1.6, shown) for shown in POSES)))
    assert [one["number"] for one in told["told"] if one["step"] in ("next", "done")] == [1, 2, 3, 4, 5, 6]
    assert told["told"][-1]["step"] == "done"
    assert told["missed"] == []
    assert told["result"] == "Calibrated."
    poses = np.array([one["pose"] for one in told["told"]])
    assert poses[np.flatnonzero(np.diff(poses, prepend=0))].tolist() == [1, 0, 2, 0, 3, 0, 4, 0, 5, 0]
    held = np.bincount(poses, minlength=6)[1:] / 30
    assert held[0] == pytest.approx(3, abs=0.15)
    assert held[1:] == pytest.approx([1] * 4, abs=0.15)
    assert told["gains"] == pytest.approx({"mouthPucker": 1.6, "mouthFunnel": 1.6})  # 0.8 / 0.5


def test_somebody_who_does_nothing_is_asked_twice_and_learns_what_was_not_seen(run: Run) -> None:
    told = run("calibration", performed((3.1, {}), (12.5, {"jawOpen": 0.1}), (70, {})))
    steps = [(one["number"], one["step"]) for one in told["told"] if one["step"] != "same"]
    assert steps == [
        (1, "next"),
        *((n, step) for n in range(2, 6) for step in ("again", "next")),
        (6, "again"),
        (6, "done"),
    ]
    assert told["missed"] == ["open mouth", "smile", "raised eyebrows", "shut eyes", "puckered lips"]
    assert told["result"].startswith("Not calibrated: no pose was seen")
    assert not any(one["pose"] for one in told["told"] if one["number"] > 1)
    assert "A little more." in {one["remark"] for one in told["told"] if one["number"] == 2}


def test_a_calibration_waits_until_the_face_rests_and_stands_while_none_is_seen(run: Run) -> None:
    talking = [(0.2, {"jawOpen": 0.4 * (i % 2)}) for i in range(20)]
    frames = performed(*talking, (1.5, {}))
    unseen = [(frames[-1][0] + 1000 * i / 30, False, {}) for i in range(1, 90)]
    rest = [(unseen[-1][0] + 1000 * i / 30, True, {}) for i in range(1, 90)]
    told = run("calibration", [*frames, *unseen, *rest])["told"]
    (at,) = [i for i, one in enumerate(told) if one["step"] == "next"]
    assert len(frames) + len(unseen) + 30 < at  # three still seconds, none of them while it talked or was away
    assert {one["remark"] for one in told[len(frames) : len(frames) + 80]} == {
        "Your face is not seen: the clock stands."
    }
    assert "Your face moves: let it rest." in {one["remark"] for one in told[: len(frames)]}


def test_a_face_that_never_rests_is_asked_to_and_nothing_is_learned_from_it(run: Run) -> None:
    talking = [(0.2, {"jawOpen": 0.8 * (i % 2)}) for i in range(100)]
    told = run("calibration", performed(*talking, (0.1, {}), *((1.6, shown) for shown in POSES)))
    begun = next(i for i, one in enumerate(told["told"]) if one["step"] == "next")
    assert begun == pytest.approx(30 * 20, abs=5)
    assert not any(one["pose"] for one in told["told"][10 : begun + 1])
    assert told["result"] == "Calibrated, but these poses were not seen: resting face."


def test_settings_of_a_face_are_kept_by_the_persons_name(run: Run) -> None:
    told = run("people", [])
    anna = {"person": "Anna", "gain": 1.5, "gains": {"jawOpen": 2}, "groups": {}}
    assert told["other"] == {"person": "__proto__", "gain": 1.5, "gains": {}, "groups": {}}
    assert told["again"] == anna
    assert {name: told["reloaded"][name] for name in anna} == anna
    assert "Anna" in told["people"]


def test_settings_do_to_weights_what_they_do_where_python_solves(run: Run) -> None:
    generator = torch.Generator().manual_seed(0)
    controls = WeightControls()
    groups = {"jaw": {"gain": 1.5, "dead": 0.1, "smoothing": 0.5}, "mouth": {"smoothing": 1.0}, "gaze": {"muted": True}}
    shapes = run("settings", {"groups": groups, "gains": {"mouthPucker": 2}})
    assert shapes["gain"][ARKIT.index("jawOpen")] == 1.5
    assert shapes["gain"][ARKIT.index("mouthPucker")] == 2
    assert shapes["gain"][ARKIT.index("eyeLookUpLeft")] == 0
    turns = Rotation.from_rotvec(0.3 * np.random.default_rng(0).normal(size=(9, 3))).as_matrix()
    solved = np.diag([1.0, -1.0, -1.0]) @ turns
    centre = {"rotation": solved[0].ravel().tolist(), "gaze": [0.1, 0.2, 0.1, -0.1]}
    frames, expected = [], []
    for i in range(1, 9):
        weights = torch.rand(52, generator=generator)
        settings = {**shapes, "centre": centre if i > 2 else None, "frozen": i == 6}
        gaze = torch.rand(2, 2, generator=generator)
        rotation = torch.tensor(solved[i], dtype=torch.float32)
        given = {"weights": weights, "rotation": rotation, "gaze": gaze}
        told = {name: values.flatten().tolist() for name, values in given.items()}
        frames.append({"solved": {**told, "interval": i / 40}, "settings": settings})
        controls.settings = read_weight_settings(settings)
        made = controls.apply(LiveFrame(weights, rotation, torch.zeros(68, 2), gaze=gaze), i / 40)
        expected.append(torch.cat([made.weights, made.rotation.flatten(), made.gaze.flatten()]).numpy())
    found = np.array(run("controls", frames))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    assert (found[5] == found[4]).all()  # frozen
    own = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]) @ found[-1][52:61].reshape(3, 3))
    assert (own.inv() * Rotation.from_matrix(turns[8] @ turns[0].T)).magnitude() < 1e-5
    with pytest.raises(ValueRangeError, match="expected 52 numbers from 0"):
        read_weight_settings({"gain": [1.0] * 51})


def test_times_rise_and_the_rate_is_their_mean(run: Run) -> None:
    times = [5000 + 1000 * i / 29.7 for i in range(40)]
    told = run("take", [*times[:10], times[3], times[9], *times[10:]])
    np.testing.assert_allclose(told["seconds"], (np.array(times) - 5000) / 1000, atol=1e-5)
    assert told["rate"] == pytest.approx(29.7, rel=1e-5)


def test_slow_drawing_takes_half_of_the_time_at_most_and_becomes_coarser_where_that_helps(run: Run) -> None:
    quick = [(3.0, 0.0)] * 50
    took, rests, ratios = np.array(run("pace", [*quick, (5000.0, 0.0), *quick, *[(5.0, 20.0)] * 40])).T
    assert not rests[took < 4].any()
    assert rests[50] < 1000  # the first drawing takes seconds, and the character is awaited
    assert (ratios[:101] == 2).all()  # one slow drawing is none
    slow = took[101:] > 12
    assert (took[101:] / (took + rests)[101:])[slow].max() < 0.51
    assert 0.5 <= ratios[-1] < 0.7
    assert not slow[-1]
    of_corners = np.array(run("pace", [(60.0, 1.0)] * 40))
    assert (of_corners[:, 2] < 2).any()
    assert (of_corners[20:, 2] == 2).all()  # fewer pixels were no quicker

"""The guided calibration of ``live`` on films of people who do, or do not, what they are asked for."""

from pathlib import Path

import pytest
import torch

from torchface.io import load_take
from torchface.io.video import write_video
from torchface.shape_names import ARKIT
from torchface.workflows.live.kept_takes import WEIGHTS
from torchface.workflows.live.live_anybody import LiveSettings, go_live, person_solver
from torchface.workflows.live.session_prompts import STEPS
from train.rendered_people.webcam_performance import SittingSettings, sitting
from train.rendered_people.webcam_video import WebcamSettings, draw_subject, webcam_frames

pytestmark = pytest.mark.bench
FPS, STEP, AFTER = 20.0, 2.0, 3.0  # frames a second; seconds a pose, and of a full smile behind the calibration
POSES = ((), ("jawOpen",), ("mouthSmileLeft", "mouthSmileRight"),
         ("browInnerUp", "browOuterUpLeft", "browOuterUpRight"), ("eyeBlinkLeft", "eyeBlinkRight"))  # fmt: skip
STRENGTH = {"jawOpen": 0.8, "eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}
SMILE = 0.55  # this person's widest, of the rig's


def film(path: Path, left_out: int | None) -> Path:
    """Someone who goes through the poses, without one of them, and smiles as widely as they can afterwards."""
    generator = torch.Generator().manual_seed(21)
    person = draw_subject(generator)
    weights = torch.zeros(round(FPS * (STEP * len(POSES) + AFTER)), len(ARKIT))
    for number, names in enumerate((*POSES, POSES[2])):
        if number == left_out:
            continue
        begin, end = round(FPS * STEP * number), round(FPS * (STEP * number + (STEP if number < 5 else AFTER)))
        ramp = (torch.arange(end - begin) / (0.3 * FPS)).clamp(max=1)
        for name in names:
            weights[begin:end, ARKIT.index(name)] = ramp * STRENGTH.get(name, SMILE if "Smile" in name else 0.8)
    acted = sitting(weights, FPS, generator, SittingSettings(distance=450))
    frames = webcam_frames(person, acted, 21, WebcamSettings(320, 240, focal=300))
    write_video((frame.picture[None] for frame in frames), path, FPS)
    return path


@pytest.mark.parametrize("left_out", [None, 3])
def test_poses_are_seen_and_a_narrow_smile_counts_as_a_whole_one(tmp_path: Path, left_out: int | None) -> None:
    path, said = film(tmp_path / "film.mp4", left_out), list[str]()
    smiles = {}
    for calibrate in (True, False):
        out = tmp_path / f"take {calibrate}"
        settings = LiveSettings(str(path), record=out, calibrate=calibrate, page=False)
        go_live(settings, said.append if calibrate else str, str, person_solver)
        take = load_take(out / WEIGHTS)
        smiles[calibrate] = float(take.weights.select(POSES[2]).values[-20:].mean())
    print(
        f"\nleft out: {left_out}; the smile afterwards {smiles[True]:.2f} calibrated, {smiles[False]:.2f} not; {said}"
    )
    asked = [words for words in said if " of 5: " in words]
    assert asked == [f"{number + 1} of 5: {words}" for number, words in enumerate(STEPS)]
    assert said[-1 if said[-1].startswith("Calibrated") else -2] == (
        "Calibrated" if left_out is None else f"Calibrated, but these poses were not seen: {STEPS[left_out]}"
    )
    assert smiles[True] > smiles[False] + 0.05

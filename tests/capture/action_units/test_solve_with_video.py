"""The command solves markers with a video: what the markers hardly see comes from the painted patterns."""

from dataclasses import replace
from pathlib import Path

import pytest

from torchface import load_take, save_rig, zoo
from torchface.capture.action_units import ActionUnitClassifier
from torchface.cli import main
from train.filmed_performers.camera_stage import RecordedSession
from train.filmed_performers.label_files import save_action_labels


def test_the_video_leads_what_markers_hardly_see(
    session: RecordedSession, classifier: ActionUnitClassifier, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    zoo.save_model(classifier, tmp_path / "units", zoo.ModelCard("MIT", "filmed", {}, "none"))
    save_rig(session.rig, tmp_path / "rig.glb")
    session.attachment.save(tmp_path / "attachment.json")
    words = [
        "solve",
        str(tmp_path / "rig.glb"),
        str(session.take_path),
        "--attachment",
        str(tmp_path / "attachment.json"),
    ]
    errors = []
    for name, more in (
        ("alone", []),
        ("hybrid", ["--video", str(session.video.path), "--action-units", str(tmp_path / "units")]),
    ):
        main([*words, *more, "--out", str(tmp_path / f"{name}.csv"), "--quiet"])
        solved = load_take(tmp_path / f"{name}.csv").weights
        errors.append((session.rig.weights_from(solved) - session.performance.weights).abs().mean(0))
    told = capsys.readouterr().err
    assert "video: predicts" in told
    assert "correlate" not in told
    led = session.rig.index(["noseSneerLeft", "noseSneerRight", "cheekSquintLeft", "cheekSquintRight"])
    alone, hybrid = errors
    assert float(hybrid[led].mean()) < 0.7 * float(alone[led].mean())
    save_action_labels(replace(session.labels, offset=1.0), tmp_path / "moved.toml")
    moved = ["--video", str(session.video.path), "--video-labels", str(tmp_path / "moved.toml")]
    main([*words, *moved, "--action-units", str(tmp_path / "units"), "--out", str(tmp_path / "w.csv"), "--quiet"])
    assert "with `offset` in its labels -1.0" in " ".join(capsys.readouterr().err.split())
    with pytest.raises(SystemExit):
        main([*words, "--video", str(session.video.path), "--out", str(tmp_path / "w.csv"), "--quiet"])
    assert "expected both or neither" in " ".join(capsys.readouterr().err.split())

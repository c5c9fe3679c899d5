"""USD files read without a process of their own, which takes half a second each."""

import json
from collections.abc import Sequence
from pathlib import Path

import pytest

from torchface.errors import FileFormatError
from torchface.io.scene_processes.scene_arrays import Scene

pytest.importorskip("pxr")
from torchface.io.usd import stage_process, usd_reading


def read_here(command: Sequence[str], path: Path, reader: str, seconds: float) -> Scene:
    """What ``read_scene`` gives, by the same functions in this process."""
    try:
        extract = stage_process.extract_maps if "--maps" in command else stage_process.extract
        record, arrays = extract(path.absolute(), lambda size: None)
    except stage_process.Refused as refused:
        raise FileFormatError(f"{path}: found {refused.found}, expected {refused.expected}") from None
    scene = Scene(path, json.loads(json.dumps(record)), arrays)
    scene.warn_of_left_out()
    return scene


@pytest.fixture
def same_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reads USD files in this process."""
    monkeypatch.setattr(usd_reading, "read_scene", read_here)

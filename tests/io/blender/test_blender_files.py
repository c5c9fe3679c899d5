"""Without Blender: what runs it, and what is said where it is missing or fails."""

import importlib.util
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rig_samples import sheet_rig

from torchface.errors import FileFormatError, MissingExtraError
from torchface.io import save_rig
from torchface.io.blender import read_blender_file, write_blender_file
from torchface.io.blender.blender_files import PROGRAM, blender_command


def program(path: Path, text: str) -> Path:
    """A stand-in for Blender."""
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without Blender."""
    monkeypatch.delenv(PROGRAM, raising=False)
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "bpy" else found(name))
    monkeypatch.setattr(shutil, "which", lambda name: None)


@pytest.mark.usefixtures("nothing")
def test_without_blender_the_ways_to_have_it_are_named(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    with pytest.raises(MissingExtraError, match=rf"neither bpy nor Blender.*pip install bpy.*{PROGRAM}"):
        read_blender_file(tmp_path / "rig.fbx")
    save_rig(sheet_rig(), tmp_path / "rig.glb")
    assert "neither bpy nor Blender" in messages_of("convert", tmp_path / "rig.glb", tmp_path / "rig.fbx", status=2)


def test_the_program_that_is_named_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    blender = program(tmp_path / "blender-4.5", "exit 0")
    monkeypatch.setenv(PROGRAM, str(blender))
    assert blender_command("script.py")[:2] == [str(blender), "--background"]
    assert blender_command("script.py")[-1] == "--"
    monkeypatch.setenv(PROGRAM, sys.executable)
    assert blender_command("script.py")[:2] == [sys.executable, "-I"]
    monkeypatch.setenv(PROGRAM, str(tmp_path / "gone"))
    with pytest.raises(MissingExtraError, match=r"found no program .*gone"):
        blender_command("script.py")


def test_a_blender_that_fails_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(PROGRAM, str(program(tmp_path / "blender", "echo it broke; exit 7")))
    (tmp_path / "rig.fbx").write_bytes(b"Kaydara")
    with pytest.raises(FileFormatError, match=r"rig\.fbx: Blender ended with status 7 \(it broke\)"):
        read_blender_file(tmp_path / "rig.fbx")
    monkeypatch.setenv(PROGRAM, str(program(tmp_path / "blender", "kill -SEGV $$")))
    with pytest.raises(FileFormatError, match="Blender ended with SIGSEGV"):
        write_blender_file(sheet_rig(), tmp_path / "new.fbx")
    monkeypatch.setenv(PROGRAM, str(program(tmp_path / "blender", "exit 0")))
    with pytest.raises(FileFormatError, match="Blender wrote nothing"):
        write_blender_file(sheet_rig(), tmp_path / "new.fbx")
    assert not (tmp_path / "new.fbx").exists()

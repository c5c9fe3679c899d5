"""Commands that cannot go on end with a line, not with a traceback."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchface.cli import main
from torchface.cli.exit_messages import plain_errors
from torchface.errors import FileFormatError
from torchface.files.whole_files import check_writable, make_folder
from torchface.io import save_rig, save_take
from torchface.rig import BlendshapeRig
from torchface.synthetic.stages.marker_stage import place_markers, record


@pytest.fixture(scope="module")
def stage(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig, an attachment, a take, and a file where a folder might be expected."""
    folder = tmp_path_factory.mktemp("stage")
    sites = place_markers(dome_rig, 30)
    sites.save(folder / "attachment.json")
    save_rig(dome_rig, folder / "rig.glb")
    save_take(record(dome_rig, sites, torch.zeros(5, 4), torch.Generator().manual_seed(0)).take, folder / "take.c3d")
    (folder / "file").write_text("no folder")
    return folder


@pytest.mark.parametrize("option", ["--report", "--out", "--animation", "--live-link"])
def test_a_place_that_cannot_be_written_to_is_named_before_the_solve(
    stage: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["solve", stage / "rig.glb", stage / "take.c3d", "--attachment", stage / "attachment.json", "--quiet"]
    outs = {"--out": stage / "weights.csv", option: stage / "file" / "here.csv"}
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in (*words, *(word for pair in outs.items() for word in pair))])
    assert ended.value.code == 2
    assert f"{stage / 'file' / 'here.csv'}: cannot be written" in capsys.readouterr().err.replace("\n", "")
    assert not (stage / "weights.csv").exists()


def test_folders_are_made_or_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    assert make_folder(tmp_path / "a" / "b").is_dir()
    check_writable(None, tmp_path / "c" / "d.csv")
    assert not (tmp_path / "c").exists()
    for refused in (make_folder, check_writable):
        with pytest.raises(FileFormatError, match=r"file.b: (found no folder|cannot be written)"):
            refused(tmp_path / "file" / "b")


def test_what_a_system_call_says_is_told_with_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, plain_errors():
        raise PermissionError(13, "Permission denied", "/some/file")
    assert ended.value.code == 2
    assert "error: /some/file: Permission denied" in capsys.readouterr().err
    with pytest.raises(OSError, match="nobody's"), plain_errors():
        raise OSError("nobody's")


def test_ctrl_c_ends_a_command_without_a_traceback() -> None:
    program = (
        "import os, signal, torchface.cli as cli\n"
        "def info(path: str) -> None:\n"
        "    'Stops itself.'\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "cli.COMMANDS['info'] = info\n"
        "cli.main(['info', '--path', 'x'])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 130
    assert "stopped" in done.stderr
    assert "Traceback" not in done.stderr

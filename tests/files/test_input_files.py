"""Inputs of a command stay as they are, whatever it writes."""

from pathlib import Path

import pytest

from torchface.errors import FileFormatError
from torchface.files.input_files import kept_inputs
from torchface.files.whole_files import delete_file, read_file, replaced_file, write_file


def test_nothing_is_written_over_an_input_whatever_a_command_forgets(tmp_path: Path) -> None:
    taken, folder = tmp_path / "taken.csv", tmp_path / "actor"
    folder.mkdir()
    inside, unread, out = folder / "neutral.obj", folder / "render.png", tmp_path / "out.csv"
    for path in (taken, inside, unread):
        path.write_bytes(b"content")
    with kept_inputs([taken, folder], [("--out", out)]):
        assert read_file(inside) == b"content"
        for path in (taken, inside):
            with pytest.raises(FileFormatError, match="is the input"):
                write_file(path, b"new")
            with pytest.raises(FileFormatError, match="is the input"), replaced_file(path) as temporary:
                temporary.write_bytes(b"new")
            with pytest.raises(FileFormatError, match="is the input"):
                delete_file(path)
            assert path.read_bytes() == b"content"
        write_file(unread, b"new")
        write_file(out, b"new")
        assert read_file(out) == b"new"
        write_file(out, b"newer")  # what a command reads again of its own is no input
    write_file(taken, b"new")


def test_a_folder_that_is_an_input_is_no_output(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="is the input"), kept_inputs([tmp_path], [("--out", tmp_path)]):
        pass

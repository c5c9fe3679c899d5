"""A folder of numbered pictures where a film is expected: the command that is named reads all of them."""

import shlex
from pathlib import Path

import pytest
from PIL import Image

from torchface.errors import FileFormatError
from torchface.io.video import open_video
from torchface.io.video.numbered_pictures import film_of_pictures
from torchface.io.video.video_packets import pyav
from torchface.workflows.batch.batch_items import find_items
from torchface.workflows.track.video_job import VIDEOS


@pytest.mark.parametrize(
    ("names", "pattern"),
    [
        ([f"f{i:03d}.png" for i in range(12)], "f%03d.png"),
        ([f"{i}.jpg" for i in range(98, 104)], "%02d.jpg"),
        ([f"shot 1 100%_{i}.png" for i in range(1, 12)], "shot 1 100%%_%d.png"),
    ],
)
def test_the_films_command_names_all_pictures(names: list[str], pattern: str, tmp_path: Path) -> None:
    folder = tmp_path / "pictures of 1"
    folder.mkdir()
    for name in names:
        Image.new("RGB", (16, 16)).save(folder / name)
    (folder / "notes.txt").write_text("9")
    with pytest.raises(FileFormatError) as error:
        open_video(folder)
    program, *options, film = shlex.split(str(error.value).partition("were taken: ")[2])
    assert (program, film, options[-1]) == ("ffmpeg", "film.mkv", f"{folder}/{pattern}")
    start = {"start_number": options[options.index("-start_number") + 1]} if "-start_number" in options else {}
    with pyav().open(options[-1], format="image2", options=start) as container:
        assert sum(1 for _ in container.decode(video=0)) == len(names)
    with pytest.raises(FileFormatError, match=f"found no video in the folder.*{len(names)} numbered pictures"):
        find_items([folder], VIDEOS)


def test_a_folder_without_pictures_names_no_command(tmp_path: Path) -> None:
    (tmp_path / "one1.png").write_bytes(b"")
    assert film_of_pictures(tmp_path) == ""


def test_a_missing_number_is_said_in_place_of_a_command_that_stops_there(tmp_path: Path) -> None:
    for number in (1, 2, 4, 5):
        (tmp_path / f"f_{number:04d}.png").touch()
    words = film_of_pictures(tmp_path)
    assert "its 4 numbered pictures 1 are missing" in words
    assert "ffmpeg" not in words

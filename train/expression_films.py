"""``python -m train.expression_films --out FOLDER``: films of rendered people with the true weights of every frame.

FOLDER gets NAME.mp4 and NAME.csv, the truth as Live Link Face writes it, for each film: run any tracker on the films
and compare what it gives by ``torchface evaluate RESULTS FOLDER --benchmark``. People, lights and motion are drawn from
seeds that no recipe uses. The twelve take about five minutes of one core; what is rendered is kept.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import plain_errors
from torchface.errors import NameMismatchError
from torchface.files.job_lock import job_lock
from torchface.files.whole_files import make_folder, write_file
from torchface.io.weights.live_link_csv import save_live_link
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT
from torchface.take import Take, Track
from torchface.workflows.head_rotations import eye_angles, head_angles

from .rendered_people.webcam_film import FPS, Film, FilmSources, Scene, webcam_film
from .rendered_people.webcam_performance import SittingSettings, gaze_of
from .rendered_people.webcam_video import WebcamSettings

_FACE = 150.0  # millimetres from ear to ear
_WIDTH = 0.9  # of the picture, is a webcam's focal length


def _scene(people: str, seed: int, part: tuple[int, float, float], size: tuple[int, int, int], **more: object) -> Scene:
    """A scene of a part of a take (number, first second, seconds) in a picture (width, height) with so wide a face."""
    number, start, length = part
    width, height, face = size
    focal = _WIDTH * width
    turning = float(more.pop("turning", 9.0))  # type: ignore[arg-type]
    distance = focal * _FACE / face
    moved = SittingSettings(distance, (0.01 * distance, 0.02 * distance), float(more.pop("roll", 0.0)), turning)  # type: ignore[arg-type]
    camera = WebcamSettings(
        width, height, focal, noise=2.0 if height > 400 else 4.0, quality=80 if height > 400 else 60
    )
    return Scene(people, seed, number, start, length, replace(moved, drift=0.03 * distance), camera=camera, **more)  # type: ignore[arg-type]


FILMS = {
    "laugh_hd": _scene("ict", 93001, (2, 21.6, 4.0), (1280, 720, 300), looks="plain"),
    "brows_near": _scene("performer", 93002, (2, 1.5, 4.0), (640, 480, 170), looks="plain", roll=6.0),
    "smile_glasses": _scene("ict", 93003, (3, 9.4, 4.0), (640, 480, 140), looks="glasses"),
    "squint_beard": _scene("performer", 93004, (3, 0.2, 4.0), (640, 360, 100), looks="beard", blinks=(2.4,)),
    "turning_hd": _scene("ict", 93005, (1, 6.5, 4.0), (1280, 720, 200), turning=26.0),
    "talk_webcam": _scene("performer", 93006, (1, 12.9, 4.0), (640, 480, 120), speech=(0.2, 3.8)),
    "look_hand": _scene("ict", 93007, (0, 21.2, 5.0), (640, 480, 130), hand=2.6, blinks=(1.1,)),
    "talk_small": _scene("performer", 93008, (0, 10.6, 4.0), (480, 360, 80), speech=(0.2, 3.8), blinks=(0.8, 2.9)),
    "frown_both": _scene("ict", 93009, (5, 6.6, 4.0), (960, 540, 150), looks="both", roll=-8.0),
    "blinks_240": _scene("performer", 93010, (5, 13.9, 4.0), (426, 240, 55), blinks=(3.0,)),
    "look_tiny": _scene("ict", 93011, (4, 3.6, 4.0), (320, 240, 40), speech=(0.3, 3.7), looks="plain"),
    "turning_240": _scene("performer", 93012, (2, 12.9, 4.0), (426, 240, 60), turning=22.0),
}
"""Pictures of 720 to 240 rows, faces of 300 to 40 pixels, glasses, beards, a hand, heads that turn to 50 degrees."""

SMALL = ("laugh_hd", "smile_glasses", "talk_webcam", "turning_240")
"""Those of which ``small`` keeps the first two seconds."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is rendered.

    Args:
        out: Folder for the films and their truth.
        takes: Folder of real takes (.csv, Live Link Face) whose weights the people act; made by code without.
        ict: ICT-FaceKit's FaceXModel folder, for six films of its heads; embedded performers alone without.
        films: Names of those wanted; all if absent.
        small: Four films of two seconds instead..
    """

    out: Path = Path("out/expression_films")
    takes: Path | None = None
    ict: Path | None = None
    films: tuple[str, ...] = ()
    small: bool = False


def scenes(settings: Settings) -> dict[str, Scene]:
    """What the settings ask for."""
    unknown = [name for name in settings.films if name not in FILMS]
    if unknown:
        raise NameMismatchError(f"--films: found {', '.join(unknown)}, expected some of {', '.join(FILMS)}")
    if not settings.small:
        return {name: FILMS[name] for name in settings.films or FILMS}
    return {name: replace(FILMS[name], length=2.0) for name in settings.films or SMALL}


def render(settings: Settings, progress: Progress | None = None) -> dict[str, Film]:
    """Renders films that are not there yet, and writes the truth of each beside it."""
    progress, made = progress or silent, {}
    sources = FilmSources(settings.takes, settings.ict)
    for name, scene in scenes(settings).items():
        film = webcam_film(scene, sources, settings.out / ".rendered", progress)
        video = settings.out / f"{name}.mp4"
        video.unlink(missing_ok=True)
        try:
            os.link(film.path, video)
        except OSError:  # a file system without links
            write_file(video, film.path.read_bytes())
        save_live_link(truth(film), settings.out / f"{name}.csv")
        made[name] = film
    return made


def truth(film: Film) -> Take:
    """The true weights, head and eye rotations of a film as a take."""
    acted = film.performance
    eyes = torch.stack([eye_angles(gaze) for gaze in gaze_of(acted.weights).double()])
    angles = torch.cat([head_angles(acted.rotation.double()), eyes], 1)
    columns = {name: angles[:, number] for number, name in enumerate(ROTATIONS)}
    return Take(FPS, weights=Track(ARKIT, acted.weights[..., None]), extras={"columns": columns})


def main() -> None:
    """Renders what the command line asks for."""
    with plain_errors():
        settings = tyro.cli(Settings, description=__doc__)
        make_folder(settings.out)
        with job_lock(settings.out), progress_bars() as progress:
            made = render(settings, progress)
        print(f"{len(made)} films in {settings.out}")


if __name__ == "__main__":
    main()

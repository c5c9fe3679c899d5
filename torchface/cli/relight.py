"""``torchface relight``: a tracked face under another light, with another skin or another head."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path


def relight(
    film: Positional[Path],
    track: Path,
    out: OutputPath = Path("relit.mp4"),
    light: tuple[str, ...] = (),
    environment: Path | None = None,
    turn: float = 0.0,
    exposure: float = 1.0,
    texture: Path | None = None,
    rig: Path | None = None,
    film_light: Literal["once", "each"] = "once",
    occluders: bool = True,
    quiet: Quiet = False,
) -> None:
    """Show a tracked face under another light, with another skin, or another head in its place, in its film.

    The film's light is estimated from the rig's colours; pixels are multiplied by the quotient of new and old light, so
    pores and beard stay. Hands, hair and other things before the face stay in front of it as they are.

    Args:
        film: The video that was tracked.
        track: The folder that `torchface track` wrote of it.
        out: The video to write.
        light: Another light: azimuth=60 (degrees from the camera to the viewer's right) elevation=20 strength=1
            (as bright as in the film) ambient=0.3 (share from everywhere) red=1 green=1 blue=1 (beside the film's).
        environment: A panorama of light (.hdr) around the head; its middle is where the camera stands.
        turn: Turns the panorama: its middle so many degrees to the viewer's right.
        exposure: How many times as bright as in the film the panorama makes the face.
        texture: An image in the rig's texture coordinates to put on the skin, lit as the face is; where it is
            transparent the film shows.
        rig: A head with a texture to show in the face's place; it moves as the actor does.
        film_light: Estimate the film's light once, or every eight frames, for lights that change or move.
        occluders: Leave what is before the face as it is. --no-occluders relights all but what is behind it.
    """
    from torchface.workflows.relight.relight_film import RelightSettings, relight_film

    settings = RelightSettings(light, environment, turn, exposure, texture, rig, film_light, occluders)
    with progress_bars(quiet) as progress:
        lines = relight_film(film, track, out, settings, progress)
    print_lines(lines)
    print_path(out)

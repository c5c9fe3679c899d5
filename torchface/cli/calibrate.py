"""``torchface calibrate``: a camera's focal length and lens distortion from images of a checkerboard."""

import re
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path
from torchface.errors import ValueRangeError


def calibrate(
    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...")],
    out: OutputPath = Path("camera.toml"),
    corners: str = "9x6",
    square: float = 25.0,
    beside: UseAppendAction[tuple[Path, ...]] = (),
    quiet: Quiet = False,
) -> None:
    """Calibrate a camera from images of a checkerboard, or a video of one, and write it as .toml.

    Hold the board at ten or more places: tilted this way and that, near, far, and in the corners of the image. Beside
    OUT lies an image of the corners found and of the same views without distortion, in which the board is straight.

    Args:
        images: Image files of one size, five at least that differ, or one video.
        out: The .toml to write.
        corners: Inner corners of the board, where four squares meet, columns x rows.
        square: A square's side, millimetres.
        beside: Films by other cameras that are fixed to the first, again for each, of the same board at the same time,
            by timecode or begun together: OUT then says where all cameras lie, for `torchface track --cameras`.
    """
    from torchface.files.job_lock import file_lock
    from torchface.workflows.calibrate_beside import calibrate_beside
    from torchface.workflows.calibrate_camera import Board
    from torchface.workflows.calibrate_camera import calibrate as run

    match = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", corners.strip())
    if match is None:
        raise ValueRangeError(f"--corners: found {corners!r}, expected columns x rows such as 9x6")
    if beside and len(images) != 1:
        raise ValueRangeError(f"calibrate: found {len(images)} files and --beside, expected one film and --beside")
    board = Board(int(match[1]), int(match[2]), square)
    with file_lock(out, ".toml"), progress_bars(quiet) as progress:
        if beside:
            reports, _, more = calibrate_beside([*images, *beside], board, out, progress)
        else:
            reports, more = [run(images, board, out, progress)], []
    print_lines([*(line for report in reports for line in report.lines()), *more])
    for path in (*(report.overlay_path for report in reports if report.overlay_path is not None), out):
        print_path(path)

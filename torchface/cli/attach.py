"""``torchface attach``: where the markers sit, fitted to a range of motion."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchface.cli.batch_report import Cluster, Column, Jobs, TimeLimit, work_on
from torchface.cli.command_options import OptionalOutputPath, OutputPath, Part
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path

_COLUMNS = (
    Column("marker error", "error_mm", "{:.2f} mm"),
    Column("worst marker", "worst_mm", "{:.2f} mm"),
    Column("markers", "markers", "{}"),
    Column("frames", "frames", "{}"),
)


def attach(
    rig: Positional[Path],
    rom: Annotated[Positional[tuple[Path, ...]], arg(metavar="ROM...")],
    out: OutputPath = Path("attachment.json"),
    initial: Path | None = None,
    standoff: bool = False,
    picture: OptionalOutputPath = None,
    part: Part = None,
    labels: Path | None = None,
    frames: str | None = None,
    unit: Literal["um", "mm", "cm", "m", "in"] | None = None,
    flip: Literal["x", "y", "z"] | None = None,
    scale: Literal["held", "free"] | None = None,
    insist: bool = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
) -> None:
    """Find where markers sit on a rig from a range-of-motion take, and write them as attachment JSON.

    Swapped labels, spikes and the motion of a slipping helmet are taken out; sites and shapes that the take leaves
    uncertain are named, and what the rig does not explain ends in an error.

    Several takes, or a folder of them: OUT is a folder, for NAME.json and NAME.png of each. {name} in an option's
    path is the take's name. One that cannot be worked on is reported and skipped, and the exit status is 1; started
    again, the command goes on where it was.

    Args:
        rig: The performer's rig: a .glb or USD file, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        rom: Markers over a range of motion: .c3d, .trc or .csv. Every expression, strongly; no frame need be neutral.
            Or several, or folders of them.
        out: The attachment to write.
        initial: Where the markers sit roughly: an attachment or landmarks as `torchface pick` writes them, labelled
            like the markers. Without it the pose is found by the markers' shape alone.
        standoff: Markers stand off the skin by one unknown distance: estimate it.
        picture: Also draw where each marker sat and sits, and its error after each iteration: .png or .jpg.
        labels: What the take's labels are called in INITIAL, and from then on: CSV, a row LABEL OF THE TAKE,LABEL
            each; an empty second cell leaves the marker out, with Jane:* all of a subject's. Unlabelled points and
            subjects' prefixes (Actor:M001) are left out without it.
        frames: Use the frames A:B of the take only, from A up to, not including, B; counted from 0, also in a take that
            was trimmed.
        unit: What the take's coordinates are in: um, mm, cm, m or in; else what the file says (CSV: millimetres).
        flip: Negate this axis of the take's coordinates: for takes exported in left-handed axes, which are mirrored.
        scale: Of the take against the rig: held at 1, or free, to be estimated. Held where the unit is known (C3D, TRC,
            --unit), if absent.
        insist: Write the sites although the rig does not explain the markers, or the take leaves most of them
            uncertain.
    """
    from torchface.errors import ValueRangeError
    from torchface.files.job_lock import file_lock
    from torchface.workflows.attach.attach_markers import MOTIONS, AttachSettings, MotionJob
    from torchface.workflows.attach.attach_markers import attach as find_sites
    from torchface.workflows.batch.batch_items import check_folder, is_batch
    from torchface.workflows.marker_input import MarkerOptions

    settings = AttachSettings(initial, standoff, part, MarkerOptions(unit, labels, frames, flip, scale), insist)
    if cluster is not None or is_batch(rom, MOTIONS):
        check_folder(out)
        if picture is not None:
            raise ValueRangeError("--picture: found many takes, of which each gets OUT/NAME.png without it")
        job = MotionJob(rig, settings)
        work_on(job, MOTIONS, rom, out, (jobs, cluster, time_limit), _COLUMNS, "error_mm", quiet)
        return
    with file_lock(out, ".json"), progress_bars(quiet) as progress:
        report = find_sites(rig, rom[0], out, settings, picture, progress)
    print_lines(report.lines())
    print_path(out)
    if picture is not None:
        print_path(picture)

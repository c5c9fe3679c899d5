"""``torchface solve``: markers in, weights out."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchface.cli.batch_report import Cluster, Column, Jobs, TimeLimit, work_on
from torchface.cli.command_options import OptionalOutputPath, OutputPath, Part, Reduce
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path

_COLUMNS = (
    Column("marker RMSE", "rmse_mm", "{:.3f} mm"),
    Column("95 %", "rmse_p95_mm", "{:.3f} mm"),
    Column("seen", "seen", "{:.1%}"),
    Column("frames", "frames", "{}"),
)


def solve(
    rig: Positional[Path],
    take: Annotated[Positional[tuple[Path, ...]], arg(metavar="TAKE...")],
    attachment: Path,
    out: OutputPath = Path("out/weights.csv"),
    live_link: OptionalOutputPath = None,
    animation: OptionalOutputPath = None,
    reduce: Reduce = None,
    neutral: Annotated[int | None, arg(aliases=["--neutral-frame"])] = None,
    align: bool = False,
    keep_rest: bool = False,
    slip: bool = False,
    clean: bool = False,
    frame_by_frame: bool = False,
    video: Path | None = None,
    action_units: str | None = None,
    video_labels: Path | None = None,
    table: Path | None = None,
    units: tuple[str, ...] = (),
    gamma: float | None = None,
    report: OptionalOutputPath = None,
    stream: str | None = None,
    sparsity: float | None = None,
    ridge: float | None = None,
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
    """Solve a marker take for blendshape weights.

    Several takes, or a folder of them: OUT is a folder, for NAME.csv of each take, records/, summary.csv and
    contact_sheet.png. {name} in an option's path is the take's name, as in --attachment sites/{name}.json --report
    reports/{name}. A take that cannot be solved is reported and skipped, and the exit status is 1; started again, the
    command goes on where it was.

    Args:
        rig: A .glb or USD file, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        take: Markers: .c3d, .trc or .csv; or several, or folders of them.
        attachment: Where the markers sit on the rig, as JSON. Markers match by label; a subject's prefix (Actor:M001)
            and another case do not matter, labels that it does not know are left out.
        out: The weights to write: Live Link Face CSV if each of the rig's shapes is one of ARKit's, otherwise
            frame,time,<shape>,... with the rig's own names.
        live_link: Also write Live Link Face CSV whatever the rig's names are: halves are merged, shapes that ARKit does
            not have are left out.
        animation: Also write the rig with this animation as .glb, USD or .ma (Maya).
        neutral: A frame with the face at rest, counted as --frames does: the take is moved onto the rig by it (rotation
            and translation; --scale for the scale).
        align: Move the take onto the rig without a neutral frame. With neither, markers are in the rig's space.
        keep_rest: Do not subtract what is left at rest between a moved take and the rig.
        slip: The helmet moves on the head, or the head moves in the capture volume (with --align or --neutral): find
            this motion, and keep it out of the weights.
        clean: Find swapped labels, spikes and markers that drift or fell off, and repair what is safe.
        frame_by_frame: Solve every frame on its own, with the markers' noise in the curves. Otherwise the whole take is
            solved at once: smooth curves, gaps interpolated, fast motion keeps its height.
        video: What a head camera saw of painted patterns during the take; leads the shapes that markers hardly see.
        action_units: The classifier for the video, by name or folder; see `torchface train action_units`.
        video_labels: Where helmet, markers and regions are in the video, TOML; VIDEO with .toml for its ending if
            absent.
        table: What action units mean in the rig's shapes, TOML; built in for ARKit's and ICT-FaceKit's names.
        units: Which of the classifier's action units lead, such as 4 9 18L; all if absent.
        gamma: How much a prediction weighs at most, mm² over all markers; 4 if absent.
        report: A folder for a page: the face playing, the error of each marker, what was wrong, every curve.
        stream: Then send the solved frames in their own time: as Live Link Face does to udp://127.0.0.1:11111 for
            Unreal on this machine, by the VMC protocol to vmc://HOST:PORT, or to any other address that
            `torchface live --to` takes.
        sparsity: Pull of each weight toward zero, square millimetres; the default suits 0.3 mm noise.
        ridge: Quadratic pull of each weight toward zero, square millimetres.
        labels: What the take's labels are called in the attachment: CSV, a row LABEL OF THE TAKE,LABEL OF THE
            ATTACHMENT each; an empty second cell leaves the marker out, with Jane:* all of a subject's.
        frames: Solve the frames A:B of the take only, from A up to, not including, B; counted from 0, as in OUT, also
            in a take that was trimmed.
        unit: What the take's coordinates are in: um, mm, cm, m or in; else what the file says (CSV: millimetres).
        flip: Negate this axis of the take's coordinates: for takes exported in left-handed axes, which are mirrored.
        scale: Of the take against the rig: held at 1, or free, to be estimated. Held where the unit is known (C3D, TRC,
            --unit), if absent.
        insist: Write weights although the rig does not explain the markers.
    """
    from torchface.capture.markers.hybrid_solver import GAMMA
    from torchface.errors import FileFormatError, ValueRangeError
    from torchface.files.job_lock import file_lock
    from torchface.workflows.batch.batch_items import check_folder, check_for_each, is_batch
    from torchface.workflows.marker_input import MARKER_TAKES, MarkerOptions
    from torchface.workflows.solve.head_camera import HeadCamera
    from torchface.workflows.solve.solution import SolveSettings
    from torchface.workflows.solve.solve_take import TakeInputs, TakeOutputs, solve_take
    from torchface.workflows.solve.take_job import TakeJob
    from torchface.workflows.weight_files import checked_reduction

    if labels is not None and labels.suffix.lower() == ".toml":
        raise FileFormatError(f"{labels}: found TOML, expected a .csv; labels of a video go to --video-labels")
    if (video is None) != (action_units is None):
        raise ValueRangeError("solve: found one of --video and --action-units, expected both or neither")
    camera = None
    if video is not None and action_units is not None:
        camera = HeadCamera(video, action_units, video_labels, table, units, GAMMA if gamma is None else gamma)

    settings = SolveSettings(neutral, align, not keep_rest, slip, clean, frame_by_frame, insist=insist)
    if sparsity is not None:
        settings = replace(settings, sparsity=sparsity)
    if ridge is not None:
        settings = replace(settings, ridge=ridge)
    options = MarkerOptions(unit, labels, frames, flip, scale)
    if cluster is not None or is_batch(take, MARKER_TAKES):
        if stream is not None:
            raise ValueRangeError("--stream: found many takes, expected one that is sent")
        check_folder(out)
        written = {"--animation": animation, "--report": report, "--live-link": live_link}
        for option, path in written.items():
            check_for_each(option, path)
        job = TakeJob(
            rig, attachment, settings, options, part, camera, animation, report, live_link, checked_reduction(reduce)
        )
        work_on(job, MARKER_TAKES, take, out, (jobs, cluster, time_limit), _COLUMNS, "rmse_mm", quiet)
        return
    outputs = TakeOutputs(out, animation, live_link, reduce, report, stream)
    with file_lock(out, ".csv"), progress_bars(quiet) as progress:
        inputs = TakeInputs(rig, take[0], attachment, part, camera, options)
        done = solve_take(inputs, outputs, settings, progress)
    print_lines(done.lines())
    for path in (out, animation, live_link, None if report is None else report / "index.html"):
        if path is not None:
            print_path(path)

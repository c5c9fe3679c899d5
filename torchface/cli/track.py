"""``torchface track``: a face in a video as weights of the actor's rig."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from torchface.cli.batch_report import Cluster, Column, Jobs, TimeLimit, work_on
from torchface.cli.command_options import Output, Part, Reduce, picture_size
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_path, print_table

_COLUMNS = (
    Column("frames", "frames", "{}"),
    Column("face found", "seen", "{:.1%}"),
    Column("landmarks off by", "error_px", "{:.2f} px"),
    Column("jitter", "jitter_px", "{:.2f} px"),
)
_TABLES = ("weights.csv", "confidence.csv", "live_link.csv", "landmarks.csv", "landmark_offsets.json")
_FILES = (*_TABLES, "animation.glb", "overlay.mp4")


def track(
    video: Annotated[Positional[tuple[Path, ...]], arg(metavar="VIDEO...")] = (),
    *,
    rig: Path | None = None,
    out: Annotated[Path | None, Output(_FILES)] = None,
    landmarks: str = "landmark_network",
    appearance: str | None = None,
    prior: str = "shape_prior",
    dynamics: str | None = None,
    offsets: Path | None = None,
    neutral_frame: int | None = None,
    camera: Path | None = None,
    videos: Annotated[UseAppendAction[tuple[Path, ...]], arg(name="video")] = (),
    cameras: Path | None = None,
    face: int = 0,
    one_person: bool = False,
    anybody: bool = False,
    head_model: str | None = None,
    whole_take: bool = False,
    part: Part = None,
    overlay: Literal["side", "over", "none"] = "side",
    fps: float | None = None,
    size: str | None = None,
    reduce: Reduce = None,
    solver: Literal["rig", "examples"] = "rig",
    examples: tuple[Path, ...] = (),
    method: Literal["all", "regional", "linear"] = "all",
    jobs: Jobs = 1,
    cluster: Cluster = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
) -> None:
    """Track a face in a video and solve it for the weights of a rig; no markers are needed.

    The rig is the actor's own (--rig). Without one the head of whoever is seen is solved with the take, and lies in OUT
    as head.glb.

    Landmarks, the camera, then weights and where the head is. Writes into OUT: weights.csv by the rig's names,
    confidence.csv (how much of each shape was seen), live_link.csv for Unreal (head rotation included), landmarks.csv,
    landmark_offsets.json, animation.glb, overlay.mp4, summary.json and the report index.html. Killed and started again,
    it goes on where it was; what depends on nothing that has changed is kept.

    Several videos, or a folder of them: OUT is a folder, for a folder NAME of each. {name} in an option's path is the
    video's name. One that cannot be tracked is reported and skipped, and the exit status is 1.

    Args:
        video: A file: .avi, .mkv, .webm, .mp4, .mov or .gif, of one size; its frame rate may vary. Or several, or
            folders of them.
        rig: The actor's own rig, with 68 annotated landmarks: .glb, USD, or ICT-FaceKit's FaceXModel folder.
            A head is solved if absent.
        out: Folder for everything.
        landmarks: What finds the 68 landmarks: a model of the zoo by name or folder, an .onnx file, or MediaPipe's Face
            Landmarker bundle (.task); or a .csv that holds them, ours, OpenFace's, py-feat's or MediaPipe's mesh, then
            VIDEO may be left out.
        appearance: Model of the actor's own looks that refines them.
        prior: What weights faces have, by a shape prior's name or folder, see `torchface train priors`, or none. With
            the default a landmark network that reads expressions uses its own mean and covariance of the weights;
            `shape_prior` is used with landmarks from anything else.
        dynamics: A dynamics prior, the motion of weights from frame to frame, at any frame rate.
        offsets: Fixed offsets between the rig's landmarks and those found, as an earlier take wrote them; those in OUT,
            or estimated with the take, if absent.
        neutral_frame: A frame of VIDEO, from 0, in which the face has no expression: what the rig differs by there is
            taken out. Without it the frames in which the face rests are found.
        camera: The camera's calibration, as `torchface calibrate` writes it; a focal length is assumed without.
        videos: Films of one take by several cameras, again for each, in the order of --cameras; the overlay is of the
            first. In place of VIDEO.
        cameras: Where these cameras lie, as `torchface calibrate --beside` writes it.
        face: Which of several faces to follow, from 0, the largest first.
        one_person: All frames show the actor: solve those after a cut too in which the face looks like another's.
        anybody: The rig is not the actor's: a head is solved with its shapes, and the head model's topology.
        head_model: Which head model a head is solved with, by name or folder; if absent one of people in
            $TORCHFACE_HOME or the checkout, else `head`, of performers made by code.
        whole_take: Smooth landmarks over all frames, those after each too; with --dynamics the weights as well.
        overlay: overlay.mp4: the rig, in its texture or clay, beside the picture, parts of low confidence tinted; half
            through over it; or none.
        fps: Frames a second of a .csv of landmarks without VIDEO; by its times if absent.
        size: WIDTHxHEIGHT of the pictures that such landmarks were found in; the camera's if absent.
        solver: By the rig, or by example expressions: weights.csv then has theirs, methods.csv the error and time of
            each method on this video, overlay.mp4 the solved example's landmarks (red) over those found.
        examples: What `torchface examples` wrote, for --solver examples; of several people the mean is taken.
        method: With examples: all at once, the head first and then regions, or by a linear model of landmarks.
    """
    from torchface.errors import ValueRangeError
    from torchface.workflows.batch.batch_items import is_batch
    from torchface.workflows.track.track_inputs import TrackSettings
    from torchface.workflows.track.video_job import VIDEOS, VideoJob
    from torchface.workflows.weight_files import checked_reduction

    beside = videos[1:]
    if videos:
        if video or solver == "examples" or cluster is not None:
            raise ValueRangeError("track: found --video beside VIDEO, --cluster or examples, expected it alone")
        video = videos[:1]
    if not video and not landmarks.lower().endswith(".csv"):
        raise ValueRangeError("track: found no VIDEO, expected one, or a .csv of landmarks; a webcam: torchface live")
    if solver == "examples":
        if out is None or len(video) > 1 or rig is not None:
            raise ValueRangeError("track: found --solver examples, expected one VIDEO, --examples and --out beside it")
        _by_examples(video[0] if video else None, examples, out, method, landmarks, face, quiet)
        return
    settings = TrackSettings(
        landmarks,
        appearance,
        prior,
        dynamics,
        camera,
        face,
        whole_take,
        part,
        overlay,
        fps,
        None if size is None else picture_size(size),
        offsets,
        one_person,
        checked_reduction(reduce),
        anybody,
        head_model,
        neutral_frame,
        beside,
        cameras,
    )
    if out is None:
        raise ValueRangeError("track: found no folder for the results, expected one (--out DIR)")
    if cluster is not None or (video and is_batch(video, VIDEOS)):
        job = VideoJob(rig, settings)
        work_on(job, VIDEOS, video, out, (jobs, cluster, time_limit), _COLUMNS, "error_px", quiet)
        return
    _file(video[0] if video else None, rig, out, settings, quiet)


def _file(video: Path | None, rig: Path | None, out: Path, settings: object, quiet: bool) -> None:
    from torchface.files.job_lock import job_lock
    from torchface.workflows.track.track_inputs import TrackSettings
    from torchface.workflows.track.track_page import write_track_page
    from torchface.workflows.track.track_video import track_video

    assert isinstance(settings, TrackSettings)
    with job_lock(out), progress_bars(quiet) as progress:
        tracked = track_video(video, rig, out, settings, progress)
        progress("writing the report")
        page = write_track_page(tracked, out)
    for line in tracked.lines():
        console.print(line, highlight=False, soft_wrap=True)
    for path in (*tracked.products.values(), page):
        print_path(path)


def _by_examples(
    video: Path | None,
    examples: tuple[Path, ...],
    out: Path,
    method: Literal["all", "regional", "linear"],
    landmarks: str,
    face: int,
    quiet: bool,
) -> None:
    from torchface.files.job_lock import job_lock
    from torchface.workflows.examples.example_take import track_by_examples

    with job_lock(out), progress_bars(quiet) as progress:
        done = track_by_examples(video, examples, out, method, landmarks, face, progress)
    print_table(
        (one.method, f"{one.pixels:.2f} px, {one.share:.2%} of the eyes' distance, {one.milliseconds:.2f} ms a frame")
        for one in done.figures
    )
    for path in done.products.values():
        print_path(path)

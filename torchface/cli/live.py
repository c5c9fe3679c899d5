"""``torchface live``: anybody before a webcam, or with a phone, moves a character."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from torchface.cli.command_options import OptionalOutputPath, Output, picture_size
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path

if TYPE_CHECKING:
    from torchface.progress import Progress
    from torchface.workflows.live.live_frames import FaceSolver

_FILES = ("weights.csv", "live_link.csv", "animation.glb")


def live(
    camera: Annotated[Positional[str], arg(metavar="CAMERA|VIDEO|ADDRESS")] = "0",
    *,
    character: Path | None = None,
    mapping: Path | None = None,
    calibrate: bool = False,
    to: UseAppendAction[tuple[str, ...]] = (),
    record: Annotated[Path | None, Output(_FILES)] = None,
    takes: OptionalOutputPath = None,
    page: bool = True,
    port: int = 8080,
    size: str = "640x480",
    landmarks: str | None = None,
    solver: Literal["webcam", "examples"] = "webcam",
    examples: tuple[Path, ...] = (),
    method: Literal["all", "regional", "linear"] = "all",
    loop: bool = False,
    seconds: float | None = None,
    enhance: str | None = None,
    cameras: Annotated[bool, arg(name="list")] = False,
    quiet: Quiet = False,
) -> None:
    """Move a character with your face, before a webcam or by a phone; no scan, no markers, no training.

    A page in the browser, the one of `torchface export app`, shows the character and the camera's picture with what
    was found in it. It has a guided calibration, settings by groups of shapes, and takes that are recorded, played and
    renamed; the stream view at /stream shows the character alone, for OBS. It is at 127.0.0.1, no other machine can
    open it, and no picture leaves this one. Ends with Ctrl+C. In a checkout Node builds the page once; --no-page does
    without.

    Args:
        camera: A camera's number, from 0; a video file that is played in its own time, of which --record misses no
            frame; or an address at which a phone or a program sends a face: livelink://:11111 (Live Link Face),
            ifacialmocap://PHONE (its address; it is asked to send), vmc://:39539, osc://:9000/PREFIX.
        character: A .glb or .vrm, whose data may be compressed, or a USD file or folder of OBJ files, with shapes by
            ARKit's names; the embedded performer if absent.
        mapping: For shapes by other names: a mapping table, TOML, as `torchface retarget` takes it.
        calibrate: Begin with the guided calibration: rest, then five poses, each of which is checked; without the page
            the terminal asks for rest and four poses, two seconds each.
        to: Where weights are sent to, again for each: livelink://HOST:11111 (Live Link Face, for Unreal),
            vmc://HOST:39539 (VMC protocol), osc://HOST:PORT/PREFIX (PREFIX/weights/jawOpen and so on),
            vrchat://HOST:9000, vts://HOST:8001 (VTube Studio), ifacialmocap://HOST:49983. Options of an address:
            ?rate=30 (frames a second at most), map=FILE (a mapping table), names=arkit+vrm0+vrm1 (vmc).
        record: Record from the first frame on into this folder: weights.csv by the character's names, live_link.csv,
            animation.glb (the character's own file with weights, head, neck and eyes), summary.json; where it holds a
            take, into a folder take_2 of it. The page's button records into `recordings` without.
        takes: The folder of the page's takes, where its button records too; recordings that lie in it (CSV of Live Link
            Face, iFacialMocap's and Face Cap's text, JSON of face anchors) become takes. `recordings` if absent.
        page: Open the page in the browser.
        port: The first port to try for the page.
        size: WIDTHxHEIGHT to ask the camera for.
        landmarks: What finds the 68 landmarks, as `torchface track` takes it: a model by name or folder, an .onnx file,
            or MediaPipe's Face Landmarker, .task; the webcam's own graph, which is the quickest, if absent.
        solver: The webcam's own, or by example expressions as the dissertation's program: the page's picture then shows
            the solved example's landmarks (red) over those found (green).
        examples: What `torchface examples` wrote, or folders of it, for --solver examples; of several people the mean.
        method: With examples: all at once, the head first and then regions, or by a linear model of landmarks.
        loop: Play a video file again and again.
        seconds: After which it ends; until Ctrl+C if absent.
        enhance: An actor's model, by name or folder, as `torchface enhance` takes it: when the session ends, each take
            gets a folder `enhanced` with the actor's wrinkles on its character; the page and --to stay as they are.
        cameras: Only list the cameras.
    """
    from torchface.errors import FileFormatError, ValueRangeError
    from torchface.files.whole_files import visible_files
    from torchface.workflows.live.camera_devices import check_source, list_cameras

    if cameras:
        found = list_cameras()
        for number, name in found.items():
            print(f"{number}  {name}".rstrip())
        if not found:
            console.print("no camera found; a video file does as well: torchface live film.mp4")
        return
    sides = picture_size(size)
    check_source(camera)
    from torchface.workflows.live.live_anybody import LiveSettings, go_live, person_solver

    make_solver: Callable[[Progress], FaceSolver] = person_solver
    if (solver == "examples") != bool(examples):
        raise ValueRangeError("live: found one of --solver examples and --examples FILE, expected both or neither")
    if examples:
        from torchface.workflows.examples.live_examples import ExamplesSolver

        files = [one for path in examples for one in (visible_files(path, (".json",)) if path.is_dir() else [path])]
        if not files:
            raise FileFormatError(f"{examples[0]}: found no .json, expected what `torchface examples` wrote")
        make_solver = partial(ExamplesSolver, files, method, landmarks)
    elif landmarks is not None:
        from torchface.workflows.live.finder_solver import FinderSolver

        make_solver = partial(FinderSolver, landmarks)
    settings = LiveSettings(
        camera, character, mapping, to, record, takes, calibrate, page, port, loop, seconds, enhance, sides
    )

    def opened(url: str) -> None:
        console.print("Open this page; Ctrl+C ends.")
        print(url, flush=True)

    def say(words: str) -> None:
        console.print(words, highlight=False, soft_wrap=True)

    with progress_bars(quiet) as progress:
        report, saved = go_live(settings, say, opened, make_solver, progress)
    print_lines(report.lines())
    for take in saved:
        if take.error:
            raise FileFormatError(f"{take.folder}: the recording of {take.frames} frames is not kept: {take.error}")
        if take.frames:
            print_path(take.folder)

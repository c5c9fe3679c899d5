"""``torchface examples``: a person's example expressions, or a rig's, for the solve from landmarks."""

from pathlib import Path

from tyro.conf import Positional

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path


def examples(
    pictures: Positional[tuple[Path, ...]] = (),
    *,
    out: OutputPath,
    camera: str | None = None,
    rig: Path | None = None,
    paper: bool = False,
    seconds: float = 4.0,
    landmarks: str = "landmark_network",
    quiet: Quiet = False,
) -> None:
    """Make the examples that a solve from landmarks mixes: from pictures, before a webcam, or from a rig.

    From PICTURES: a folder or files named by what they show (neutral, brow_lower_left, brow_raise_left,
    brow_lower_right, brow_raise_right, suck, pull_open, pull_left, pull_right, lower_lip_depress, pucker, stretch,
    rotate_left, rotate_right, tilt_left, tilt_right; or ARKit's names), or these 16 in this order. With --camera you
    are asked for one after the other. With --rig a rig's own shapes are seen by a camera. Left is the person's left,
    in pictures that are not mirrored. Then: torchface export examples OUT --out solver.onnx.

    Args:
        pictures: Pictures of one person, or a folder of them.
        out: The .json file to write.
        camera: A camera's number, or a video file in which somebody went through the 16 to the same clock.
        rig: A .glb or USD file, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder; with landmarks annotated.
        paper: Of the rig only the 16 above, made of ARKit's shapes.
        seconds: For each expression before the camera.
        landmarks: What finds landmarks: a model of the zoo by name or folder, an .onnx file, or MediaPipe's Face
            Landmarker bundle (.task).
    """
    from torchface.capture.anybody import (
        ExampleSolver,
        example_remarks,
        landmark_observability,
        paper_examples,
        rig_examples,
    )
    from torchface.errors import ValueRangeError
    from torchface.files.job_lock import file_lock
    from torchface.io import load_rig
    from torchface.workflows.examples.guided_session import guided_examples
    from torchface.workflows.examples.picture_examples import picture_examples

    given = [name for name, there in (("PICTURES", pictures), ("--camera", camera), ("--rig", rig)) if there]
    if len(given) != 1:
        raise ValueRangeError(
            f"examples: found {' and '.join(given) or 'nothing'}, expected PICTURES, --camera or --rig"
        )
    with file_lock(out, ".json"):
        if camera is not None:
            made = guided_examples(camera, lambda words: console.print(words, highlight=False), seconds, landmarks)
        else:
            with progress_bars(quiet) as progress:
                if rig is not None:
                    progress("reading the rig")
                    loaded = load_rig(rig)
                    made = paper_examples(loaded) if paper else rig_examples(loaded)
                else:
                    made = picture_examples(pictures, landmarks, progress)
        made.save(out)
    if not quiet:
        remarks = [] if rig is not None else example_remarks(made)
        print_lines([*remarks, *str(landmark_observability(ExampleSolver(made))).splitlines()])
    print_path(out)

"""``torchface export``: ONNX graphs for applications without PyTorch."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from torchface.cli.command_options import Output, OutputPath, Part
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path, print_table

Method = Literal["splitting", "projected-gradient"]


def solver(
    rig: Positional[Path],
    attachment: Path,
    out: OutputPath,
    method: Method = "splitting",
    hybrid: bool = False,
    part: Part = None,
    quiet: Quiet = False,
) -> None:
    """Write the marker solve of one rig and one marker layout as an ONNX file, and check it.

    Inputs of the graph: `markers` (B,M,3), millimetres in the rig's space without the motion of helmet or head, NaN
    where not seen, and `previous` (B,N), the weights of the frame before (zeros will do). Output: `weights` (B,N).
    Shape names, marker labels and units are in the file's metadata. ONNX Runtime is compared with PyTorch, and the
    graph with the exact solve at 0, 10 and 30 % missing markers.

    Args:
        rig: A .glb or USD file, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        attachment: Where the markers sit, as JSON.
        out: The .onnx file to write.
        method: How the graph solves: operator splitting, the quicker one, or projected gradient, a loop without a
            factorisation.
        hybrid: The hybrid solve, with two inputs more: `predicted` (B,N), weights in [0,1] that a classifier says, and
            `gamma` (B,N), how much that counts (0 to 4; 0 leaves a frame to its markers).
    """
    from torchface.attachment import Attachment
    from torchface.capture import MarkerSolver
    from torchface.files.job_lock import file_lock
    from torchface.io import load_rig
    from torchface.onnx import GraphSteps
    from torchface.onnx.solver_graph_export import export_marker_solver

    with file_lock(out, ".onnx"), progress_bars(quiet) as progress:
        progress("reading the rig")
        loaded, where = load_rig(rig, part=part), Attachment.load(attachment)
        where.check(loaded.neutral, attachment, rig)
        solver = MarkerSolver(loaded, where)
        report = export_marker_solver(solver, out, GraphSteps(method=method), hybrid=hybrid, progress=progress)
    print_lines([report.verdict()])
    print_table(report.rows())
    print_path(out)


def action_units(model: Positional[str], out: OutputPath, quiet: Quiet = False) -> None:
    """Write an action unit classifier as an ONNX file, and check it.

    Inputs of the graph: `regions` (B,R,h,w), painted patterns in [0,1], and `rest` (R,h,w), the same of the face at
    rest. Output: `intensities` (B,A). The names of regions and units are in the file's metadata.

    Args:
        model: Its name in the zoo, or a folder that `torchface train action_units` wrote.
        out: The .onnx file to write.
    """
    from torchface import zoo
    from torchface.capture import ActionUnitClassifier
    from torchface.files.job_lock import file_lock
    from torchface.onnx import export_action_units

    with file_lock(out, ".onnx"), progress_bars(quiet) as progress:
        progress("reading the classifier")
        classifier = zoo.get_model(model, ActionUnitClassifier)
        progress("exporting and checking")
        report = export_action_units(classifier, out)
    print_table(report.rows())
    print_path(out)


def video_solver(
    rig: Positional[Path],
    camera: Path,
    out: OutputPath,
    prior: str | None = None,
    dynamics: str | None = None,
    fps: float | None = None,
    landmarks: Path | None = None,
    offsets: Path | None = None,
    part: Part = None,
    quiet: Quiet = False,
) -> None:
    """Write the video solve of one rig and one camera as an ONNX file, and check it: `torchface track`'s of a table.

    Of a film `track` also counts the expression and the eyes that networks read, which no graph takes.

    Inputs of the graph: `landmarks` (68,2), pixels, NaN where not seen, `confidence` (68,), and what the frame before
    gave, `previous_` and its name; all NaN for the first frame. Outputs: `weights` (N,), `rotation` (3,3),
    `translation` (3,), millimetres, and with a dynamics prior `window`, `mean` and `covariance`. Pixels are of images
    without distortion. ONNX Runtime is compared with PyTorch, and the graph with the exact solve over a video. The
    settings are those of `torchface track`, and in the file's metadata.

    Args:
        rig: A .glb or USD file, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder; with landmarks annotated.
        camera: The camera's calibration, as `torchface calibrate` writes it.
        out: The .onnx file to write.
        prior: A shape prior: a model's name in the zoo, or a folder.
        dynamics: A dynamics prior: a model's name in the zoo, or a folder.
        fps: Frames a second of the application's camera; those that the dynamics prior has learned if absent.
        landmarks: The landmarks.csv that `torchface track` wrote of a video of this camera, to check the graph with; a
            synthetic video if absent.
        offsets: The landmark_offsets.json that `torchface track` wrote of this person and rig; without it the rig's
            landmarks are taken to lie where they are found.
    """
    from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
    from torchface.errors import FileFormatError, ValueRangeError
    from torchface.files.job_lock import file_lock
    from torchface.io import load_take
    from torchface.io.camera_files import load_calibration
    from torchface.number_checks import check_rate
    from torchface.onnx import export_video_solver
    from torchface.workflows.named_priors import load_priors
    from torchface.workflows.track.take_solution import rig_digest
    from torchface.workflows.track.track_inputs import load_actor
    from torchface.workflows.track.upright_rig import upright

    with file_lock(out, ".onnx"), progress_bars(quiet) as progress:
        if fps is not None:
            check_rate(fps, "--fps", ValueRangeError)
        progress("reading rig, camera and priors")
        (loaded, about), calibration = upright(load_actor(rig, part)), load_calibration(camera)
        priors = load_priors(loaded, prior, dynamics, fps)
        video = None if landmarks is None else load_take(landmarks).landmarks
        if landmarks is not None and video is None:
            raise FileFormatError(f"{landmarks}: found no landmarks, expected the landmarks.csv of torchface track")
        shift = None if offsets is None else LandmarkOffsets.load(offsets)
        if shift is not None and offsets is not None:
            shift.require(rig_digest(loaded), "", offsets)
        progress("exporting and checking")
        report = export_video_solver(
            loaded, calibration, out, priors.shapes, priors.dynamics, video=video, offsets=shift
        )
    print_table(report.rows())
    print_lines([about] if about else [])
    if priors.unlearned:
        console.print(f"the priors say nothing of {', '.join(priors.unlearned)}", soft_wrap=True)
    print_path(out)


def examples(
    examples: Positional[Path],
    out: OutputPath,
    solver: Literal["all-at-once", "regional", "model"] = "all-at-once",
    quiet: Quiet = False,
) -> None:
    """Write the solve of a face's 68 landmarks for the weights of examples as an ONNX file, and check it.

    Inputs of the graph: `landmarks` (B,68,2), pixels, NaN where not seen, and `previous` (B,N), what the frame before
    gave as `carried`, zeros to start. Outputs: `weights` (B,N) in [0,1] and `carried`. Squared distances are minimised.
    The names of the shapes are in the file's metadata. ONNX Runtime is compared with the exact solve.

    Args:
        examples: What `torchface examples` wrote.
        out: The .onnx file to write.
        solver: All shapes at once, with size, roll and place solved for; the head first and then regions; or projected
            on a linear model of landmarks. The last two place the face by boxes.
    """
    from torchface.capture.anybody import (
        AllAtOnce,
        ExampleMethod,
        ExampleShapes,
        ExampleSolver,
        LandmarkBoxes,
        LandmarkModel,
        Regional,
        SolvedSimilarity,
    )
    from torchface.files.job_lock import file_lock
    from torchface.onnx import export_example_solver

    with file_lock(out, ".onnx"), progress_bars(quiet) as progress:
        progress("reading the examples")
        shapes = ExampleShapes.load(examples)
        methods: dict[str, Callable[[], ExampleMethod]] = {
            "all-at-once": AllAtOnce,
            "regional": Regional,
            "model": lambda: LandmarkModel.fit(shapes),
        }
        placement = SolvedSimilarity() if solver == "all-at-once" else LandmarkBoxes()
        made = ExampleSolver(shapes, methods[solver](), placement)
        progress("exporting and checking")
        report = export_example_solver(made, out)
    print_table(report.rows())
    print_path(out)


def webcam(out: OutputPath, quiet: Quiet = False) -> None:
    """Write the whole way from a webcam's picture to ARKit's 52 weights as one ONNX file, and check it.

    Inputs of the graph: `image`, uint8 (rows, columns, 3 or 4 channels), red first, `interval`, seconds since the
    picture before, `controls` (5,), and `state`, zeros to start. Outputs: `weights` (52,), `rotation` (3,3),
    `translation` (3,), millimetres, `gaze` (2,2), radians, `landmarks` (68,2) and `iris` (2,2), pixels, `presence`,
    `calibrated`, `beside` (2,), other people to the left and right, and `next_state`, which the next picture takes. It
    finds the face, follows it and learns the person by itself; the weights move any character with ARKit's shapes. What
    it is made of is in the file's metadata. ONNX Runtime is compared with PyTorch over a rendered video.

    Args:
        out: The .onnx file to write.
    """
    from torchface.files.job_lock import file_lock
    from torchface.workflows.webcam.webcam_export import export_webcam

    with file_lock(out, ".onnx"), progress_bars(quiet) as progress:
        report = export_webcam(out, progress)
    print_table(report.rows())
    print_path(out)


def export_app(
    out: Annotated[Path, Output(("character.glb",))],
    character: Path | None = None,
    webcam: Path | None = None,
    mapping: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Write the app in the browser: a folder that any static host serves, in which a webcam moves a character.

    Everything runs on the user's machine; the page sends nothing. To try it: `python3 -m http.server --directory OUT`,
    then open http://localhost:8000. Elsewhere a camera needs https. Where the page is not part of this installation, it
    is built once, which takes Node with npm and the network.

    Args:
        out: The folder to write; an earlier app in it is replaced.
        character: A .glb, or another rig, whose shapes have ARKit's names; the embedded performer if absent.
        webcam: The graph from picture to weights, as `torchface export webcam` writes it; that one if absent.
        mapping: For shapes by other names: a mapping table, TOML, as `torchface retarget` takes it.
    """
    from torchface.workflows.browser_app import export_app as write

    with progress_bars(quiet) as progress:
        report = write(out, character, webcam, progress, mapping)
    print_table(report.rows())
    if report.still:
        console.print(f"no face moves {', '.join(report.still)}", soft_wrap=True)
    console.print(f"to try it: python3 -m http.server --directory {out}, then http://localhost:8000", soft_wrap=True)
    print_path(out)


def export_enhancement(
    *,
    model: str,
    rig: Path,
    out: Annotated[Path, Output(("wrinkles.glb", "map_weights.csv"))],
    maps: int = 4,
    size: int = 1024,
    poses: int = 300,
    animation: Path | None = None,
    pairs: Path | None = None,
    part: Part = None,
    quiet: Quiet = False,
) -> None:
    """Write an actor's wrinkles as maps for a rig, with ONNX graphs that give the maps' weights every frame.

    Writes into OUT: wrinkles.glb (the rig, its normal map at rest, and the wrinkle maps of normals and heights with the
    masks of the regions, listed in `extras.torchface.wrinkleRegions`), map_weights.onnx (`weights` (B,N) of the rig's
    shapes to `map_weights` (B,R,M)), map_weights_of_vertices.onnx (the same of `vertices` (B,V,3), millimetres), maps/
    (every map as a PNG of 16 bits) and summary.json (how much of the actor's detail the maps show). How an engine
    blends them: export/README.md.

    Args:
        model: The actor's model, by name or folder; see `torchface train enhancement`.
        rig: The rig that the engine moves, with texture coordinates; of any topology.
        out: Folder for everything.
        maps: How many wrinkle maps; each region has a weight for each.
        size: Of each map, texels a side.
        poses: Of the rig, for which the model is asked for wrinkles and that the weights are learned from.
        animation: Weights (.csv) that wrinkles.glb plays; then map_weights.csv holds the maps' weights of every frame.
        pairs: Where vertices of the rig lie on the model; see `torchface enhance`. By registration if absent.
    """
    from torchface.files.job_lock import job_lock
    from torchface.workflows.enhance.wrinkle_export import WrinkleSettings, export_wrinkles

    settings = WrinkleSettings(maps, size, poses, pairs, part, animation)
    with job_lock(out), progress_bars(quiet) as progress:
        done = export_wrinkles(model, rig, out, settings, progress)
    print_lines(done.lines())
    for path in done.products.values():
        print_path(path)


def export_model(name: str, /, out: OutputPath, quiet: Quiet = False) -> None:
    """Write a model of the zoo, or of a folder, as an ONNX file, and check it against PyTorch.

    A head model gives the decoder (coefficients to vertices and colours), an expression regression the offsets of a
    neutral face, UV landmarks the bank of filters, face landmarks the trees (grey image and boxes to 68 points),
    face boxes the network (colour image to boxes and roll angles), a marker solver the solve, a dynamics prior mean and
    deviation of the next frame's weights. Names, units, licence, data and what was measured are in the file's metadata.

    Args:
        name: Of the model, or its folder.
        out: The .onnx file to write.
    """
    from torchface import zoo
    from torchface.files.job_lock import file_lock
    from torchface.onnx import export_model as export

    with file_lock(out, ".onnx"), progress_bars(quiet) as progress:
        progress("loading the model")
        record = zoo.describe(name)
        model = zoo.get_model(name)
        facts = {
            "model": record.name,
            "kind": record.kind,
            "licence": record.licence,
            "data": record.data,
            "metrics": record.metrics,
            "recipe": record.recipe,
            "sha256": record.sha256,
        }
        progress("exporting and checking")
        report = export(model, out, facts)
    print_table(report.rows())
    print_path(out)


EXPORTS: dict[str, Callable[..., None]] = {
    "solver": solver,
    "action-units": action_units,
    "video-solver": video_solver,
    "examples": examples,
    "webcam": webcam,
    "app": export_app,
    "enhancement": export_enhancement,
}

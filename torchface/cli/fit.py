"""``torchface fit``: a person's rig from photographs."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path


def fit(
    photographs: Annotated[Positional[tuple[Path, ...]], arg(metavar="PHOTO...")],
    out: OutputPath,
    model: str | None = None,
    landmarks: tuple[str, ...] = (),
    landmark_model: str = "landmark_network",
    template: Path | None = None,
    part: str | None = None,
    focal: float | None = None,
    inner_weight: float | None = None,
    face: int | None = None,
    texture_size: int = 1024,
    names: Literal["arkit"] | None = None,
    prior: str = "shape_prior",
    one_expression: bool = False,
    everything: bool = False,
    insist: bool = False,
    quiet: Quiet = False,
) -> None:
    """Make a person's rig from one or several photographs, or of a video, and write it as .glb.

    A head model is fitted to 68 landmarks in each photograph: one identity for all, expression and pose in each, and
    the focal length at once. Landmarks that no file gives are found; they are written as .pts beside OUT, to be looked
    at and corrected.
    All photographs show one person; different expressions help to tell the person from them, and profiles beside a
    front view show how far things stand out.
    The skin that they show becomes the rig's texture. Beside OUT lies an image for each photograph: it, the fit over
    it, and the landmarks, found green and fitted red; and its camera as .toml, for `torchface track --camera` where the
    video is from the same.

    Args:
        photographs: Image files, or videos, of which sharp frames of several angles and expressions are chosen.
        landmarks: 68 landmarks in iBUG's order for each photograph: a .pts or .ljson file each, in the same order, or
            one .xml of dlib's (imglab) that names the photographs, or one .csv of a row a photograph, in their pixels
            once upright. Or what finds them: a model of the zoo by name or folder, an .onnx file, or MediaPipe's Face
            Landmarker bundle (.task).
            Found by --landmark-model if absent.
        landmark_model: What finds them, or is compared with those that files give.
        model: A head model of the zoo by name, or its folder; if absent one of people in $TORCHFACE_HOME or the
            checkout, else `head`, of performers made by code.
        out: The .glb or USD file to write, or a name without an ending for a folder of OBJ files in the template's
            vertex order.
        template: The rig whose shapes the head is given, with the model's topology; if absent the one that travels with
            the model, or the embedded performer.
        part: Keep this region of model and template, such as face of ICT-FaceKit's head.
        focal: Focal length in pixels where it is known; estimated if absent.
        inner_weight: Weight of landmarks at brows, eyes, nose and mouth beside those of the face's contour.
        face: Which face of a photograph that shows several, from 0: as faces are detected, the largest first, with and
            without landmarks from a file.
        texture_size: Texels a side of the rig's texture; 0 makes none.
        names: Names of the written shapes. "arkit": ARKit's where the template's mean the same, halves of one of its
            shapes merged (browInnerUp, cheekPuff); shapes that ARKit lacks keep theirs. All keep theirs if absent.
        prior: Which weights faces have, by a shape prior's name or folder, or none.
        one_expression: All photographs show the same expression, as taken at once.
        everything: Paint hair, clothes and what else hangs before the head on it; if absent skin, eyes, brows and mouth
            alone, with the template's hair, teeth, tongue and lashes.
        insist: Fit also what is refused otherwise, with a warning: a face that is too small or hidden, several of
            similar size, photographs that seem to show different people.
    """
    from torchface.files.job_lock import file_lock
    from torchface.modeling import FitSettings
    from torchface.workflows.fit.fit_landmarks import is_landmark_file
    from torchface.workflows.fit.photograph_rig import PhotographSettings, fit_photographs
    from torchface.workflows.rig_names import naming_lines

    given = tuple(Path(landmark) for landmark in landmarks)
    if len(landmarks) == 1 and not is_landmark_file(given[0]):
        given, landmark_model = (), landmarks[0]
    fitting = FitSettings(texture_size=texture_size, one_expression=one_expression)
    if inner_weight is not None:
        fitting = replace(fitting, inner_weight=inner_weight)
    settings = PhotographSettings(
        fitting, template, part, focal, face, landmark_model, names, prior, insist, everything
    )
    with file_lock(out), progress_bars(quiet) as progress:
        made = fit_photographs(photographs, given, model, out, settings, progress)
    print_lines([*made.lines(), *naming_lines(made.rig, names)])
    marks = (overlay.with_suffix(".pts") for overlay in made.overlays[: len(made.found)])
    cameras = (overlay.with_suffix(".toml") for overlay in made.overlays)
    for path in (*marks, *cameras, *made.overlays, out):
        print_path(path)

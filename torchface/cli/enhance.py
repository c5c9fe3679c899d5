"""``torchface enhance``: a coarse animation gets an actor's wrinkles."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchface.cli.batch_report import Cluster, Column, Jobs, TimeLimit, work_on
from torchface.cli.command_options import Output, Part
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path

_COLUMNS = (Column("frames", "frames", "{}"), Column("unlike any seen", "outside", "{:.0%}"))


_FILES = ("enhanced.safetensors", "enhanced.glb", "comparison.mp4", "frames.csv")


def enhance(
    animation: Annotated[Positional[tuple[Path, ...]], arg(metavar="INPUT...")],
    *,
    model: str,
    out: Annotated[Path, Output(_FILES)] = Path("out/enhanced"),
    rig: Path | None = None,
    attachment: Path | None = None,
    pairs: Path | None = None,
    part: Part = None,
    neutral: int | None = None,
    fps: float | None = None,
    labels: Path | None = None,
    unit: Literal["um", "mm", "cm", "m", "in"] | None = None,
    flip: Literal["x", "y", "z"] | None = None,
    meshes: Literal["none", "obj", "ply"] = "none",
    textures: Path | None = None,
    texture_size: int = 1024,
    no_glb: bool = False,
    glb_megabytes: float = 200.0,
    detail: float = 1.0,
    retime: bool = False,
    no_video: bool = False,
    height: int = 380,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
) -> None:
    """Enhance a coarse animation with the wrinkles, creases and pores of a captured actor.

    INPUT is markers (.c3d, .trc, .csv, with --attachment), weights (.csv, with --rig), an animated .glb or USD file, a
    mesh sequence (.safetensors, or .npz with vertices (T,V,3) and faces (F,3)), a folder of meshes, a frame each, or
    the folder of `torchface track`. Meshes of the model's topology pass straight; others are registered to the model,
    or by --pairs.

    Writes into OUT: enhanced.safetensors (every frame's mesh), enhanced.glb, comparison.mp4, frames.csv (how near the
    model comes, by region), summary.json and the report index.html. Killed and started again, it goes on where it was.

    Several inputs, or a folder that holds some (not a folder of still meshes, which is one): OUT gets a folder NAME of
    each. {name} in an option's path is the input's name. One that cannot be worked on is reported and skipped, and the
    exit status is 1; started again, the command goes on where it was.

    Args:
        animation: What is to be enhanced.
        model: The actor's model, by name or folder; see `torchface train enhancement`.
        out: Folder for everything.
        rig: The rig that weights move, that meshes belong to, or on which the attachment's markers sit.
        attachment: Where the markers sit, on the rig or on the model's own mesh, as JSON; at least 12.
        pairs: Where vertices of the input's topology lie on the model: a .csv with columns input and model, vertex
            numbers from 0, or a .json of `torchface pick` (input as template, model as scan); at least 12.
        neutral: A frame of the markers with the face at rest, counted from 0, also in a take that was trimmed; motion
            counts from it. From the sites if absent.
        fps: Frames a second of meshes; 30 if absent.
        labels: What the take's labels are called in the attachment; see `torchface solve`.
        unit: What the coordinates of markers or meshes are in; if absent what the file says, else millimetres.
        flip: Negate this axis of the markers' coordinates.
        meshes: Also write every frame as a mesh file of this kind.
        textures: A mesh of the model's topology with texture coordinates, such as the captured neutral: colours that
            the model has learned are also written there, an image a frame (textures/frame_0000.png).
        texture_size: Pixels a side of these images.
        no_glb: Do not write enhanced.glb.
        glb_megabytes: What its morph targets may take; a long animation is shown by principal components.
        detail: How strong the added detail is: 1 is the actor's, 0 none.
        retime: First give the motions between the animation's keyframes the actor's timing; the keyframes stay.
        no_video: Do not write comparison.mp4.
        height: Of each view of a face in the report, pixels.
    """
    from torchface.files.job_lock import job_lock
    from torchface.number_checks import checked_count, checked_number
    from torchface.viz.figures.face_views import PICTURE_HEIGHTS
    from torchface.workflows.batch.batch_items import is_batch
    from torchface.workflows.enhance.animation_job import ANIMATIONS, AnimationJob
    from torchface.workflows.enhance.coarse_input import InputSettings
    from torchface.workflows.enhance.enhance_animation import EnhanceSettings, enhance_animation
    from torchface.workflows.enhance.enhance_page import write_enhance_page
    from torchface.workflows.marker_input import MarkerOptions

    checked_count("--height", height, *PICTURE_HEIGHTS)
    given = InputSettings(rig, attachment, pairs, part, neutral, fps, MarkerOptions(unit, labels, None, flip))
    checked_count("--texture-size", texture_size, 16, 8192)
    checked_number("--detail", detail, most=1000.0)
    checked_number("--glb-megabytes", glb_megabytes, above=True)
    settings = EnhanceSettings(
        given, meshes, not no_glb, glb_megabytes, detail, not no_video, retime, textures, texture_size
    )
    if cluster is not None or is_batch(animation, ANIMATIONS):
        job = AnimationJob(model, settings, height)
        work_on(job, ANIMATIONS, animation, out, (jobs, cluster, time_limit), _COLUMNS, "outside", quiet)
        return
    with job_lock(out), progress_bars(quiet) as progress:
        done = enhance_animation(animation[0], model, out, settings, progress)
        progress("writing the report")
        page = write_enhance_page(done, out, height)
    print_lines(done.lines())
    for path in (*done.products.values(), page):
        print_path(path)

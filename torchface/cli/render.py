"""``torchface render``: images of a mesh or a rig in a pose."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path


def render(
    path: Annotated[Positional[Path], arg(metavar="FILE")],
    out: OutputPath = Path("out/render.png"),
    weights: tuple[str, ...] = (),
    take: Path | None = None,
    frame: int = 0,
    yaw: tuple[float, ...] = (0.0, 35.0, 90.0),
    height: int = 640,
    clay: bool = False,
    part: str | None = None,
    quiet: Quiet = False,
) -> None:
    """Render a mesh or rig from several sides into one image, by ray casting; no graphics driver is needed.

    An animated file is shown at rest, or in a frame of its animation by --take with the same file and --frame.
    Detail maps of shapes are not shown; the pages of `torchface view` and `live` show them.

    Args:
        path: A mesh or rig: .glb, USD, .obj, .ply, .stl, .off, a folder of OBJ files, or ICT-FaceKit's FaceXModel
            folder.
        out: The .png or .jpg to write.
        weights: Pose of a rig, such as jawOpen=0.5 mouthSmileLeft=1.
        take: Pose of a rig from a weight take, or from an animated .glb, FILE itself too, instead; the head does not
            turn.
        frame: Which frame of the take.
        yaw: Directions to look from, degrees; 0 is the front, 90 the viewer's right.
        height: Of the image, pixels.
        clay: Leave texture and vertex colours out.
        part: Keep this region only, such as face.
    """
    from torchface.errors import ValueRangeError
    from torchface.files.job_lock import file_lock
    from torchface.number_checks import checked_count
    from torchface.rendering.compositing import PICTURE_ENDINGS, save_rendered_image
    from torchface.viz.figures.face_views import PICTURE_HEIGHTS, clay_colors, face_views
    from torchface.workflows.posed_mesh import is_animated, load_posed, pose_weights

    checked_count("--height", height, *PICTURE_HEIGHTS)
    if frame and take is None:
        raise ValueRangeError(f"--frame: found {frame} without a take, expected --take (an animated .glb is one, too)")
    with file_lock(out, *PICTURE_ENDINGS), progress_bars(quiet) as progress:
        progress("reading")
        posed = load_posed(path, pose_weights(weights), take, frame, part)
        progress("rendering")
        colors = clay_colors(posed.mesh) if clay else None
        image = face_views(posed.mesh, yaw, colors, width=height * 4 // 5, height=height, framed_by=posed.neutral)
        save_rendered_image(image, out)
    print_lines(posed.faults)
    if take is None and not weights and is_animated(path):
        console.print(
            f"{path} has an animation and is shown at rest; a frame of it: --take {path} --frame N",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    print_path(out)

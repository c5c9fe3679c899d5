"""``torchface info``: what a file holds."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchface.cli.terminal import print_table


def info(
    path: Annotated[Positional[Path], arg(metavar="FILE")], attachment: Path | None = None, part: str | None = None
) -> None:
    """Say what a file holds: a rig, mesh, take, attachment, solver, video or image.

    Args:
        path: A .glb, USD, .obj, .ply, .stl, .off, .c3d, .trc, .csv, .txt (Face Cap, iFacialMocap), .json (attachment,
            Audio2Face, ARKit), .gesichter or .onnx file, arrays (.npz, .npy, .safetensors), what
            `fit` writes of a photograph (.pts, .toml), landmarks (.ljson, dlib's .xml), MediaPipe's .task, or a rig's
            folder.
        attachment: Report which shapes of the rig these markers distinguish.
        part: Look at this region of the rig only, such as face.
    """
    from torchface.workflows.describe_file import describe

    print_table(describe(path, attachment, part), str(path))

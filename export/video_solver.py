"""``python -m export.video_solver --rig RIG --camera FILE --out video_solver.onnx``: the video solve as ONNX."""

from __future__ import annotations

from pathlib import Path

import tyro

from torchface import load_rig, zoo
from torchface.capture import DynamicsPrior, ShapePrior
from torchface.errors import FileFormatError
from torchface.io.cameras import load_calibration
from torchface.onnx import export_video_solver


def video_solver(
    rig: Path, camera: Path, out: Path, prior: str | None = None, dynamics: str | None = None, part: str | None = None
) -> None:
    """Write the video solve of one rig and one camera as an ONNX file, and check it.

    Args:
        rig: A .glb, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder; with landmarks annotated.
        camera: The camera's calibration, as TOML.
        out: The .onnx file to write.
        prior: Which weights faces have: a model's name in the zoo, or a folder.
        dynamics: How weights go on: a model's name in the zoo, or a folder.
        part: Keep this region of the rig only, such as face.
    """
    shapes = None if prior is None else zoo.get_model(prior)
    if not isinstance(shapes, ShapePrior | None):
        raise FileFormatError(f"{prior}: found a {type(shapes).__name__}, expected a prior of shapes")
    motion = None if dynamics is None else zoo.get_model(dynamics)
    if not isinstance(motion, DynamicsPrior | None):
        raise FileFormatError(f"{dynamics}: found a {type(motion).__name__}, expected a prior of dynamics")
    print(export_video_solver(load_rig(rig, part=part), load_calibration(camera), out, shapes, motion))


if __name__ == "__main__":
    tyro.cli(video_solver)

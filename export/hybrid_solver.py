"""``python -m export.hybrid_solver --rig RIG --attachment FILE --out solver.onnx``: the hybrid solve as ONNX."""

from pathlib import Path

import tyro

from torchface import Attachment, load_rig
from torchface.onnx import export_solver


def hybrid_solver(rig: Path, attachment: Path, out: Path, part: str | None = None) -> None:
    """Write the hybrid solve of one rig and one marker layout as an ONNX file, and check it.

    Args:
        rig: A .glb, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        attachment: Where the markers sit, as JSON.
        out: The .onnx file to write.
        part: Keep this region of the rig only, such as face.
    """
    print(export_solver(load_rig(rig, part=part), Attachment.load(attachment), out, hybrid=True))


if __name__ == "__main__":
    tyro.cli(hybrid_solver)

"""``python -m export.video_solver --rig RIG --camera FILE --out video_solver.onnx``: the video solve as ONNX."""

import tyro

from torchface.cli.export import video_solver

if __name__ == "__main__":
    tyro.cli(video_solver)

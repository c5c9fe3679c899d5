"""``python -m export.webcam --out webcam.onnx``: from a webcam's picture to weights, as ONNX."""

import tyro

from torchface.cli.export import webcam

if __name__ == "__main__":
    tyro.cli(webcam)

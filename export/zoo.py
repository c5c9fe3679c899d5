"""``python -m export.zoo --out DIR``: models of the zoo as ONNX, each as ``DIR/NAME.onnx``."""

from pathlib import Path

import tyro

from torchface import zoo
from torchface.cli.export import export_model


def export_zoo(out: Path, names: tuple[str, ...] = ()) -> None:
    """Write models of the zoo as ONNX files, and check each against PyTorch.

    Args:
        out: The folder to write into.
        names: Of the models; all if absent.
    """
    for name in names or zoo.list_models():
        export_model(name, out / f"{name}.onnx")


if __name__ == "__main__":
    tyro.cli(export_zoo)

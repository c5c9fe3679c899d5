"""``python -m export.action_units --model NAME --out FILE``: the action unit classifier as ONNX."""

import tyro

from torchface.cli.export import action_units

if __name__ == "__main__":
    tyro.cli(action_units)

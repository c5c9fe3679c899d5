"""``python -m export.action_units --model NAME --out FILE``: the action unit classifier as ONNX."""

import tyro

from torchface import zoo
from torchface.capture import ActionUnitClassifier
from torchface.onnx import export_action_units


def action_units(model: str, out: str) -> None:
    """Write an action unit classifier as an ONNX file, and check it.

    Args:
        model: Its name in the zoo, or a folder.
        out: The .onnx file to write.
    """
    classifier = zoo.get_model(model, ActionUnitClassifier)
    print(export_action_units(classifier, out))


if __name__ == "__main__":
    tyro.cli(action_units)

"""Files of labels of head-camera videos, as a person writes them."""

from pathlib import Path
from typing import Any

from torchface.files.documents import write_toml
from torchface.io.action_labels import ActionLabels


def save_action_labels(labels: ActionLabels, path: str | Path) -> None:
    """Writes TOML, as a person would."""
    document: dict[str, Any] = {
        "format": "torchface.action_labels/1",
        "frames": labels.frames,
        "neutral": labels.neutral,
        "offset": labels.offset,
        "helmet": list(labels.helmet),
        "markers": [list(point) for point in labels.markers],
        "regions": {name: list(box) for name, box in labels.regions.items()},
        "performed": [
            {"units": list(stretch.units), "first": stretch.first, "last": stretch.last} for stretch in labels.performed
        ],
    }
    if labels.groups:
        document["groups"] = [
            {
                "name": group.name,
                "regions": list(group.regions),
                "units": list(group.units),
                "other_units": list(group.other_units),
            }
            for group in labels.groups
        ]
    write_toml(path, document)

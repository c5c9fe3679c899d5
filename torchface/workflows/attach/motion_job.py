"""One range of motion of many, from file to marker sites."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchface.files.content_keys import content_key
from torchface.workflows.attach.attach_markers import AttachSettings, attach
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.batch.contact_sheet import small_picture
from torchface.workflows.batch.outcomes import Made
from torchface.workflows.marker_input import MARKER_TAKES

MOTIONS = replace(MARKER_TAKES, done="attached")
_METHOD = "attach batch/2"


@dataclass(frozen=True)
class MotionJob:
    """How the sites of each take are found; ``{name}`` in a path is the take's name.

    Args:
        rig, settings: see :func:`attach`.
    """

    rig: Path
    settings: AttachSettings

    def key(self, item: BatchItem) -> str:
        """A key of all that the sites depend on."""
        return content_key(_METHOD, take=item.path, settings=item.settings_of(self))

    def run(self, item: BatchItem, out: Path) -> Made:
        """Finds the sites of a take and writes ``NAME.json`` and a picture of them, ``NAME.png``.

        Raises:
            TorchfaceError: they cannot be found.
        """
        own, sites, picture = item.settings_of(self), out / f"{item.name}.json", out / f"{item.name}.png"
        done = attach(own.rig, item.path, sites, own.settings, picture)
        last = done.fit.errors[-1]
        error = float(torch.as_tensor(last).mean())
        return Made(
            (sites, picture),
            {
                "error_mm": error,
                "worst_mm": float(last.max()),
                "markers": len(done.fit.attachment.triangles),
                "frames": len(done.fit.weights),
                "iterations": len(done.fit.errors),
            },
            f"{error:.2f} mm",
            done.warnings,
            small_picture(picture),
        )

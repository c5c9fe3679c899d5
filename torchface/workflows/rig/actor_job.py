"""One actor of many, from a neutral scan to a rig."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.files.content_keys import content_key
from torchface.io.meshes.named_files import named_files
from torchface.registration.landmark_files import landmark_file
from torchface.rendering.compositing import sheet
from torchface.viz.figures.error_maps import error_colors
from torchface.workflows.batch.batch_items import SCAN_ENDINGS, BatchItem, ItemKind
from torchface.workflows.batch.batch_job import model_content
from torchface.workflows.batch.contact_sheet import face_picture
from torchface.workflows.batch.outcomes import RESULT, Made, word_of
from torchface.workflows.rig.actor_report import ActorReport
from torchface.workflows.rig.actor_rig import RigOptions, rig_actor

ACTORS = ItemKind("scan", "rigged", SCAN_ENDINGS)
_METHOD = "rig batch/4"
_MAX_DISTANCE = 1.0  # millimetres, red in the picture


@dataclass(frozen=True)
class ActorJob:
    """How each actor's rig is made; ``{name}`` in a path is the scan's name."""

    # template, landmarks, examples, detail, options: see `rig_actor`; `landmarks` may be a folder of files named as the
    # scans
    template: Path
    landmarks: Path | None = None
    examples: Path | None = None
    detail: Path | None = None
    options: RigOptions = field(default_factory=RigOptions)

    def key(self, item: BatchItem) -> str:
        """A key of all that a rig depends on."""
        own, options = self._own(item), self.options
        contents = replace(
            options,
            detector=model_content(options.detector),
            model=model_content(options.model),
            expressions=model_content(options.expressions),
        )
        files = {str(path): path for path in (item.path, *named_files(item.path))}
        return content_key(_METHOD, files=files, own=replace(own, options=contents))

    def run(self, item: BatchItem, out: Path) -> Made:
        """Makes a rig and writes ``NAME.glb`` and ``NAME_registration.png``."""
        own, path = self._own(item), out / f"{item.name}.glb"
        done = rig_actor(item.path, own.template, path, own.landmarks, own.examples, own.detail, own.options)
        record = done.neutral.record
        return Made(
            (path, done.figure),
            {
                RESULT: word_of(done.verdict()),
                "median_mm": record.median_distance,
                "p95_mm": record.far_distance,
                "shown": record.shown,
                "vertices": len(done.rig.vertices),
                "shapes": len(done.rig.names),
                "examples": len(done.example_names),
            },
            f"{record.median_distance:.2f} mm on {record.shown:.0%}",
            (*record.notes, *(f"left out: {line}" for line in done.skipped)),
            _picture(done),
        )

    def _own(self, item: BatchItem) -> "ActorJob":
        own = item.settings_of(self)
        if own.landmarks is not None and own.landmarks.is_dir():
            return replace(own, landmarks=landmark_file(own.landmarks, item.path))
        return own


def _picture(done: ActorReport) -> Tensor:
    """The face, its distances to the scan (blue 0 to red 1 mm), and the shape that moves it furthest, (3,H,W)."""
    neutral, registration = done.rig.neutral, done.neutral
    distances = registration.distance.masked_fill(~registration.matched, torch.nan).to(neutral.vertices)
    furthest = done.rig.deltas[done.rig.deltas.norm(dim=-1).amax(1).argmax()]
    return sheet(
        [
            face_picture(neutral),
            face_picture(neutral, error_colors(distances, _MAX_DISTANCE, "turbo")),
            face_picture(neutral.with_vertices(neutral.vertices + furthest), framed_by=neutral),
        ],
        3,
    )

"""One video of many, tracked from file to file."""

from dataclasses import dataclass, field
from pathlib import Path

import torch

from torchface.files.content_keys import content_key
from torchface.io.video.video_file import VIDEO_ENDINGS
from torchface.workflows.batch.batch_items import BatchItem, ItemKind
from torchface.workflows.batch.batch_job import model_content
from torchface.workflows.batch.contact_sheet import face_picture
from torchface.workflows.batch.outcomes import RESULT, Made, word_of
from torchface.workflows.track.track_inputs import TrackSettings
from torchface.workflows.track.track_page import write_track_page
from torchface.workflows.track.track_video import track_video

VIDEOS = ItemKind("video", "tracked", VIDEO_ENDINGS)
_METHOD = "track batch/2"


@dataclass(frozen=True)
class VideoJob:
    """How each video is tracked; ``{name}`` in a path is the video's name."""

    # rig, settings: see `track_video`
    rig: Path | None
    settings: TrackSettings = field(default_factory=TrackSettings)

    def key(self, item: BatchItem) -> str:
        """A key of all that a video's results depend on."""
        job = item.settings_of(self)
        names = ("landmarks", "appearance", "prior", "dynamics", "heads")
        contents = {name: model_content(getattr(job.settings, name)) for name in names}
        return content_key(_METHOD, video=item.path, rig=job.rig, settings=job.settings, **contents)

    def run(self, item: BatchItem, out: Path) -> Made:
        """Tracks a video and writes the folder ``NAME``."""
        job, folder = item.settings_of(self), out / item.name
        done = track_video(item.path, job.rig, folder, job.settings)
        page = write_track_page(done, folder)
        errors = torch.where(done.seen, done.solution.errors, torch.nan)
        strongest = done.solution.weights[done.solution.weights.norm(dim=1).argmax()].to(done.shown.deltas)
        with torch.no_grad():
            picture = face_picture(done.shown.neutral.with_vertices(done.shown(strongest[None])[0]))
        seen, frames = float(done.seen.float().mean()), len(done)
        return Made(
            (*done.products.values(), page),
            {
                RESULT: word_of(done.verdict()),
                "frames": frames,
                "fps": float(done.video.fps),
                "seen": seen,
                "error_px": float(errors.nanmedian()),
                "jitter_px": done.jitter,
                **{f"{step}_seconds": spent for step, spent in done.seconds.items()},
            },
            f"{frames} frames, {seen:.0%} seen",
            picture=picture,
        )

"""One animation of many, enhanced from file to file."""

from dataclasses import dataclass, field
from pathlib import Path

from torchface.files.content_keys import content_key
from torchface.io.take_files import MARKER_ENDINGS
from torchface.workflows.animated_meshes import is_animation
from torchface.workflows.batch.batch_items import SCAN_ENDINGS, BatchItem, ItemKind
from torchface.workflows.batch.batch_job import model_content
from torchface.workflows.batch.contact_sheet import HEIGHT, WIDTH
from torchface.workflows.batch.outcomes import Made
from torchface.workflows.enhance.coarse_input import is_markers, tracked_animation
from torchface.workflows.enhance.enhance_animation import EnhanceSettings, enhance_animation, spread_frames
from torchface.workflows.enhance.enhance_page import write_enhance_page
from torchface.workflows.enhance.enhance_views import shown_frame, small_views

_METHOD = "enhance batch/3"


def is_coarse(path: Path) -> bool:
    """Whether a file holds markers, weights or meshes, or a folder meshes or a tracked video."""
    return tracked_animation(path) != path or is_animation(path) or (path.is_file() and is_markers(path))


ANIMATIONS = ItemKind(
    "animation", "enhanced", (*MARKER_ENDINGS, ".csv", ".safetensors", ".npz", *SCAN_ENDINGS), is_coarse
)


@dataclass(frozen=True)
class AnimationJob:
    """How each animation is enhanced; ``{name}`` in a path is the animation's name."""

    # model, settings: see enhance_animation
    model: str
    settings: EnhanceSettings = field(default_factory=EnhanceSettings)
    height: int = 380  # of each view of a face in the reports, pixels

    def key(self, item: BatchItem) -> str:
        """A key of all that an animation's results depend on."""
        own = item.settings_of(self)
        return content_key(_METHOD, animation=item.path, own=own, model=model_content(own.model))

    def run(self, item: BatchItem, out: Path) -> Made:
        """Enhances an animation and writes the folder ``NAME``."""
        own, folder = item.settings_of(self), out / item.name
        done = enhance_animation(item.path, own.model, folder, own.settings)
        page = write_enhance_page(done, folder, own.height)
        shown = shown_frame(done.animation, done.model, done.frames, spread_frames(done, 1)[0])
        frames = done.animation.count
        return Made(
            (*(path for path in done.products.values() if path.is_file()), page),
            {
                "frames": frames,
                "fps": done.animation.fps,
                "outside": done.outside_share,
                "enhance_seconds": done.frames.seconds,
            },
            f"{frames} frames",
            tuple(note.removeprefix("warning: ") for note in done.notes if note.startswith("warning: ")),
            small_views(shown, done.animation, done.mesh, WIDTH, HEIGHT),
        )

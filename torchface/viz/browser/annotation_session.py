"""Landmarks of some frames being corrected, without a page: moves with their neighbours, undo, saving."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.files.whole_files import unused
from torchface.landmarks.images.appearance.annotated_frames import AnnotatedFrame, save_annotated_frame


class AnnotationSession:
    """Frames whose landmarks a user corrects one after another, and saves in a folder; those ``saved`` are the
    user's own."""

    def __init__(self, frames: Sequence[AnnotatedFrame], folder: str | Path, saved: Sequence[str] = ()) -> None:
        if not frames:
            raise ShapeError("annotate: found no frame, expected at least one")
        self.frames, self.folder = list(frames), Path(folder)
        self.saved = {frame.name for frame in frames} & set(saved)
        self._history = [[frame.landmarks.double().clone()] for frame in frames]
        self._written = [frame.landmarks.double() for frame in frames]
        self._grabbed: tuple[int, Tensor] | None = None
        self.number = self._next_unsaved(-1) or 0

    @property
    def frame(self) -> AnnotatedFrame:
        """The one being corrected, as it came."""
        return self.frames[self.number]

    @property
    def landmarks(self) -> Tensor:
        """Of the frame being corrected, as they stand, (68,2) pixels."""
        return self._history[self.number][-1]

    @property
    def state(self) -> str:
        """Whether the frame being corrected is saved as it stands, for people to read."""
        changed = not torch.equal(self.landmarks, self._written[self.number])
        return "not saved" if self.frame.name not in self.saved else "changed since" if changed else "saved"

    @property
    def extent(self) -> float:
        """How large the face is in the image: root mean square distance of the landmarks from their centre."""
        points = self.frame.landmarks
        return float((points - points.mean(0)).square().sum(1).mean().sqrt())

    def show(self, number: int) -> None:
        """Switches to another frame."""
        if not 0 <= number < len(self.frames):
            raise ValueRangeError(f"frame: found {number}, expected 0 to {len(self.frames) - 1}")
        self.number, self._grabbed = number, None

    def grab(self, row: int) -> None:
        """Takes hold of a landmark: what follows until it is let go is one step of undo."""
        if not 0 <= row < len(self.landmarks):
            raise ValueRangeError(f"landmark: found {row}, expected 0 to {len(self.landmarks) - 1}")
        self._grabbed = (row, self.landmarks.clone())
        self._history[self.number].append(self.landmarks.clone())

    def drag(self, target: Tensor, reach: float = 0.0) -> None:
        r"""Moves the landmark that is grabbed; others follow with :math:`e^{-d^2 / 2r^2}` of its motion.

        Args:
            place: where to, (2,) pixels; kept inside the image.
            reach: r, pixels, d being the distance at which another one was when this one was grabbed; 0 moves this one
                alone.
        """
        if self._grabbed is None:
            raise ValueRangeError("drag: found no landmark grabbed, expected grab() first")
        if not bool(torch.isfinite(target).all()):
            raise ValueRangeError(f"drag: found the place {target.tolist()}, expected finite pixels")
        row, before = self._grabbed
        height, width = self.frame.image.shape[-2:]
        inside = torch.minimum(target.double().clamp(min=0), torch.tensor([width - 1.0, height - 1.0]).double())
        apart = (before - before[row]).square().sum(1)
        weight = torch.exp(-apart / (2 * reach**2)) if reach > 0 else torch.zeros(len(before), dtype=torch.float64)
        weight[row] = 1.0
        self._history[self.number][-1] = before + weight[:, None] * (inside - before[row])

    def let_go(self) -> None:
        """Ends a drag."""
        self._grabbed = None

    def undo(self) -> bool:
        """Takes this frame's last step back; false where there is none."""
        self._grabbed = None
        steps = self._history[self.number]
        return len(steps) > 1 and steps.pop() is not None

    def reset(self) -> None:
        """Brings the landmarks back that the frame came with; can be undone."""
        self._grabbed = None
        self._history[self.number].append(self._history[self.number][0].clone())

    def save(self) -> Path:
        """Writes the frame's image and landmarks."""
        frame = self.frame
        path = save_annotated_frame(AnnotatedFrame(frame.name, frame.image, self.landmarks), self.folder)
        self.saved.add(frame.name)
        self._written[self.number] = self.landmarks
        return path

    def keep_unsaved(self) -> list[Path]:
        """Writes the frames that changed since they were saved into the folder's ``unsaved``."""
        rows = zip(self.frames, self._history, self._written, strict=True)
        changed = [(frame, steps[-1]) for frame, steps, written in rows if not torch.equal(steps[-1], written)]
        kept = unused(self.folder / "unsaved")
        return [save_annotated_frame(replace(frame, landmarks=points), kept) for frame, points in changed]

    def advance(self) -> bool:
        """Switches to the next frame that is not saved yet; false, and stays, where all are."""
        following = self._next_unsaved(self.number)
        if following is not None:
            self.show(following)
        return following is not None

    def _next_unsaved(self, after: int) -> int | None:
        count = len(self.frames)
        order = [(after + 1 + i) % count for i in range(count)]
        return next((i for i in order if self.frames[i].name not in self.saved), None)

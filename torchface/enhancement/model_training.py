"""Learning an actor's detail from frames in memory or on disk, a few at a time; a killed run continues."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.enhancement.aligned_frames import FrameAlignment
from torchface.enhancement.detail_basis import LearnedBasis, StreamingBasis
from torchface.enhancement.displacement_detail import DisplacementDetail
from torchface.enhancement.enhancement_settings import DetailKind
from torchface.enhancement.gradient_detail import GradientDetail
from torchface.enhancement.low_pass import LowPass
from torchface.enhancement.surface_frames import PatchGradients, SurfaceFrames
from torchface.errors import ValueRangeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.io.meshes.mesh_sequence import MeshSequence
from torchface.progress import Progress

_NUMBERS = 2**25  # of the details that are learned from at a time
_LARGEST_BLOCK = 32  # frames
_SECONDS = 60.0  # between checkpoints: at 500,000 vertices one takes ten
_FAR_NEUTRAL = 0.5  # millimetres, root mean square over the head
CHECKPOINT = "learning.safetensors"


@dataclass(frozen=True, eq=False)
class Encoder:
    """What turns frames into smooth parts, features and details.

    Args:
        alignment: lays frames on the neutral.
        low_pass: smooths their displacements.
        frames: turns the vertices' frames with their smooth part.
        gradients: takes the features of patches.
        detail: encodes what the smooth part lacks.
    """

    alignment: FrameAlignment
    low_pass: LowPass
    frames: SurfaceFrames
    gradients: PatchGradients
    detail: DisplacementDetail | GradientDetail


@dataclass(frozen=True, eq=False)
class LearnedFrames:
    """What was learned of a database.

    Args:
        features: of every frame, (K,P,9).
        motion: mean displacements of the patches' smooth part, (K,P,3), millimetres.
        basis: of the details.
    """

    features: Tensor
    motion: Tensor
    basis: LearnedBasis


def learn_frames(
    frames: Tensor | MeshSequence,
    coarse: Tensor | MeshSequence | None,
    encoder: Encoder,
    rank: int,
    size: int,
    key: str,
    folder: Path | None,
    progress: Progress,
) -> LearnedFrames:
    """Goes through a database once.

    Args:
        frames: (K,V,3), millimetres, any rigid pose each.
        coarse: what a coarse animation shows of the same frames, in the same poses, where that is known.
        encoder: for their mesh.
        rank: components of the detail to keep at most.
        size: numbers of one frame's detail.
        key: of the settings; with the frames' own content it tells whether a checkpoint is of this run.
        folder: of the checkpoint; none is kept if absent.
        progress: told of frames.

    Raises:
        ValueRangeError: a frame holds NaN.
        TopologyError: a frame does not look like the neutral's mesh.
        FileFormatError: the disk is full, or the frames' file cannot be read.
    """
    count = len(frames)
    path = None if folder is None else folder / CHECKPOINT
    whole = content_key("learn_frames/1", settings=key, frames=_identity(frames), coarse=_identity(coarse), rank=rank)
    basis = StreamingBasis(size, min(rank, count))
    features, motion, done = [], [], 0
    if path is not None and (found := read_checkpoint(path, whole)) is not None:
        basis.load(found)
        features, motion, done = [found["features"]], [found["motion"]], len(found["features"])
    block = max(1, min(_LARGEST_BLOCK, _NUMBERS // size))
    saved = time.monotonic()
    with torch.no_grad():
        while done < count:
            some = _read(frames, done, block)
            shown = some if coarse is None else _read(coarse, done, block)
            displacements, pose = encoder.alignment.laid_on_neutral(shown, f"frames from {done} on")
            smooth = encoder.low_pass(displacements)
            turned = encoder.frames.turned(smooth)
            features.append(encoder.gradients.features(smooth, turned))
            motion.append(encoder.gradients.motion(smooth))
            neutral = encoder.alignment.neutral
            base = neutral + (smooth if coarse is None else displacements)
            basis.add(encoder.detail.encode(base, pose.apply(some), turned))
            done += len(some)
            progress("learning detail", done, count)
            if path is not None and done < count and time.monotonic() - saved >= _SECONDS:
                parts = {"features": torch.cat(features), "motion": torch.cat(motion)}
                write_checkpoint(path, {**basis.state, **parts}, whole)
                saved = time.monotonic()
    learned = LearnedFrames(torch.cat(features), torch.cat(motion), basis.finished())
    if path is not None:
        path.unlink(missing_ok=True)
    return learned


def warn_without_neutral(motion: Tensor) -> None:
    """Warns where no frame of a database is near its neutral; motion is that of patches, (K,P,3), millimetres."""
    distances = motion.square().sum(-1).mean(-1).sqrt()
    if float(distances.min()) > _FAR_NEUTRAL:
        warnings.warn(
            f"frames: found none nearer to the neutral than {float(distances.min()):.1f} mm (root mean square), "
            f"expected one within {_FAR_NEUTRAL} mm: sequences begin and end there; without, faces at rest get the "
            "detail of the frame that is nearest",
            stacklevel=3,
        )


def _read(frames: Tensor | MeshSequence, first: int, count: int) -> Tensor:
    """Some frames, which must be finite."""
    found = frames[first : first + count] if isinstance(frames, Tensor) else frames.read(first, first + count)
    bad = (~torch.isfinite(found)).any(-1).any(-1).nonzero()[:, 0]
    if len(bad):
        raise ValueRangeError(
            f"frames: frame {first + int(bad[0])} holds NaN or infinite vertices, expected none; leave the frame out "
            "or repair it"
        )
    return found.float()


def _identity(frames: Tensor | MeshSequence | None) -> object:
    if not isinstance(frames, MeshSequence):
        return frames
    # A thousand dense meshes take a minute to read: their file is known by name, size and time.
    told = frames.path.stat()
    return [str(frames.path.resolve()), frames.key, list(frames.shape), told.st_size, told.st_mtime_ns]


def make_encoder(neutral: Tensor, faces: Tensor, patches: Tensor, wavelength: float, detail: DetailKind) -> Encoder:
    """Of a neutral (V,3) and its faces (F,3), in patches (F,); ``wavelength`` in millimetres."""
    frames = SurfaceFrames(neutral, faces)
    gradients = frames.patch_gradients(patches, faces, neutral)
    alignment = FrameAlignment(neutral, gradients.means)
    low_pass = LowPass(neutral, faces, wavelength)
    kept = DisplacementDetail(neutral, faces, frames) if detail == "displacements" else GradientDetail(neutral, faces)
    return Encoder(alignment, low_pass, frames, gradients, kept)

"""Training of an enhancement: frames in memory or on disk, a few at a time; a killed run continues."""

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.enhancement.captured_performance import CapturedPerformance
from torchface.enhancement.detail.detail_basis import LearnedBasis, StreamingBasis, region_products
from torchface.enhancement.detail.frame_encoder import Encoder, make_encoder
from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.enhancement.enhancement_settings import EnhancementSettings, EnhancementSizes
from torchface.enhancement.matching.face_regions import regions_of_motion
from torchface.enhancement.matching.learned_map import map_shares
from torchface.enhancement.matching.patches import grow_patches
from torchface.errors import ValueRangeError
from torchface.files.checkpoints import read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.io.meshes.mesh_sequence import MeshSequence
from torchface.number_checks import checked_count, checked_type
from torchface.progress import Progress, silent

_COLOR_RANK = 32
_NUMBERS = 2**25  # of the details that are learned from at a time
_LARGEST_BLOCK = 32  # frames
_SECONDS = 60.0  # between checkpoints: at 500,000 vertices one takes ten
_FAR_NEUTRAL = 0.5  # millimetres, root mean square over the head
CHECKPOINT = "learning.safetensors"


def fit_enhancement(
    performance: CapturedPerformance,
    settings: EnhancementSettings,
    patch_size: int,
    region_count: int,
    rank: int,
    seed: int,
    folder: str | Path | None,
    progress: Progress | None,
) -> EnhancementModel:
    """The model of :meth:`EnhancementModel.fit`, which says what the arguments are."""
    progress = progress or silent
    checked_count("rank", rank, 1)
    checked_type("performance", performance, CapturedPerformance)
    faces, sequences = performance.faces, performance.sequences
    neutral = performance.neutral.detach().float()
    progress("preparing the mesh")
    patches = grow_patches(faces, len(neutral), patch_size, seed)
    encoder = make_encoder(neutral, faces, patches, settings.wavelength, settings.detail)
    terms = {"wavelength": settings.wavelength, "detail": settings.detail}
    key = content_key("enhancement/2", neutral=neutral, faces=faces, patches=patches, **terms)
    learned = learn_frames(performance, encoder, rank, key, None if folder is None else Path(folder), progress)
    warn_without_neutral(learned.motion)
    regions = regions_of_motion(learned.motion, patches, neutral, faces, region_count, performance.landmarks, seed=seed)
    frames = len(sequences)
    sizes = EnhancementSizes(
        len(neutral),
        len(faces),
        learned.features.shape[1],
        frames,
        len(learned.basis.components),
        0 if performance.colors is None else min(_COLOR_RANK, frames),
    )
    keeps_input = performance.coarse is not None
    model = EnhancementModel(
        sizes,
        regions.names,
        regions.voluntary.tolist(),
        settings,
        learned.basis.lost_share,
        keeps_input,
    )
    model.neutral, model.faces, model.patches = neutral.clone(), faces.clone(), patches
    model.region_weights, model.sequences = regions.weights.float(), sequences.clone()
    model.database_features = learned.features
    model.components, model.coefficients = learned.basis.components, learned.basis.coefficients
    progress("comparing the sequences")
    prepared = model.prepared
    model.limits = prepared.projection.limits(sequences).to(model.limits)
    if keeps_input:  # what the smooth part lacks is mostly motion, of which the map always counts whole
        products = region_products(model.components, encoder.detail.site_weights(prepared.vertex_weights))
        shares = map_shares(prepared.projection, model.coefficients, model.map_reach, products, sequences)
        model.map_shares = shares.to(model.map_shares)
    if performance.colors is not None:
        _learn_colors(model, performance.colors)
    return model.eval()


def _learn_colors(model: EnhancementModel, colors: Tensor | MeshSequence) -> None:
    """Sets a model's colour buffers from the colours (K,V,3) of the database's frames."""

    def blocks() -> Iterator[Tensor]:
        for begin in range(0, len(colors), _LARGEST_BLOCK):
            end = min(begin + _LARGEST_BLOCK, len(colors))
            yield (colors[begin:end] if isinstance(colors, Tensor) else colors.read(begin, end)).float()

    basis = StreamingBasis(3 * colors.shape[1], model.sizes.color_rank)
    model.mean_color = sum((block.sum(0) for block in blocks()), torch.zeros(colors.shape[1], 3)) / len(colors)
    for block in blocks():
        basis.add((block - model.mean_color).transpose(1, 2).flatten(1).contiguous())
    learned = basis.finished()
    model.color_components[: len(learned.components)] = learned.components
    model.color_coefficients[:, : learned.coefficients.shape[1]] = learned.coefficients


@dataclass(frozen=True, eq=False)
class LearnedFrames:
    """The features, motion and details of a database."""

    features: Tensor  # of every frame, (K,P,9)
    motion: Tensor  # mean displacements of the patches' smooth part, (K,P,3), millimetres
    basis: LearnedBasis


def learn_frames(
    performance: CapturedPerformance, encoder: Encoder, rank: int, key: str, folder: Path | None, progress: Progress
) -> LearnedFrames:
    """Goes through a database of frames in any rigid pose once; ``key`` of the settings and the content name a
    checkpoint."""
    frames, coarse = performance.frames, performance.coarse
    count, size = len(frames), encoder.detail.size
    path = None if folder is None else folder / CHECKPOINT
    whole = content_key("learn_frames/1", settings=key, frames=_identity(frames), coarse=_identity(coarse), rank=rank)
    basis = StreamingBasis(size, min(rank, count))
    features, motion, done = [], [], 0
    if path is not None and (checkpoint := read_checkpoint(path, whole)) is not None:
        basis.load(checkpoint)
        features, motion, done = [checkpoint["features"]], [checkpoint["motion"]], len(checkpoint["features"])
    block = max(1, min(_LARGEST_BLOCK, _NUMBERS // size))
    saved = time.monotonic()
    with torch.no_grad():
        while done < count:
            captured = _read(frames, done, block)
            given = captured if coarse is None else _read(coarse, done, block)
            displacements, pose = encoder.alignment.aligned(given, f"frames from {done} on")
            smooth = encoder.low_pass(displacements)
            turned = encoder.frames.turned(smooth)
            features.append(encoder.gradients.features(smooth, turned))
            motion.append(encoder.gradients.motion(smooth))
            base = encoder.alignment.neutral + (smooth if coarse is None else displacements)
            basis.add(encoder.detail.encode(base, pose.apply(captured), turned))
            done += len(captured)
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
    block = frames[first : first + count] if isinstance(frames, Tensor) else frames.read(first, first + count)
    bad = (~torch.isfinite(block)).any(-1).any(-1).nonzero()[:, 0]
    if len(bad):
        raise ValueRangeError(
            f"frames: frame {first + int(bad[0])} holds NaN or infinite vertices, expected none; leave the frame out "
            "or repair it"
        )
    return block.float()


def _identity(frames: Tensor | MeshSequence | None) -> object:
    if not isinstance(frames, MeshSequence):
        return frames
    # A thousand dense meshes take a minute to read: their file is known by name, size and time.
    status = frames.path.stat()
    return [str(frames.path.resolve()), frames.key, list(frames.shape), status.st_size, status.st_mtime_ns]

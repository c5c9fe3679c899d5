"""Learning an enhancement from a captured performance."""

from __future__ import annotations

from pathlib import Path

from torchface.enhancement.captured_performance import CapturedPerformance
from torchface.enhancement.detail_basis import StreamingBasis, region_products
from torchface.enhancement.enhancement_model import EnhancementModel
from torchface.enhancement.enhancement_settings import (
    DEFAULT_SETTINGS,
    EnhancementSettings,
    EnhancementSizes,
)
from torchface.enhancement.learned_map import map_shares
from torchface.enhancement.model_training import (
    learn_frames,
    make_encoder,
    warn_without_neutral,
)
from torchface.enhancement.patches import grow_patches
from torchface.enhancement.regions import regions_of_motion
from torchface.files.content_keys import content_key
from torchface.number_checks import checked_count
from torchface.progress import Progress, silent

_COLOR_RANK = 32


def fit_enhancement(
    performance: CapturedPerformance,
    settings: EnhancementSettings = DEFAULT_SETTINGS,
    *,
    patch_size: int = 100,
    region_count: int = 13,
    rank: int = 64,
    seed: int = 0,
    folder: str | Path | None = None,
    progress: Progress | None = None,
) -> EnhancementModel:
    """Learns from a captured performance.

    Args:
        performance: K frames of the actor.
        settings: how frames are split and detail is found.
        patch_size: vertices a patch.
        region_count: how many regions are looked for.
        rank: components of the detail.
        seed: of patches and regions.
        folder: where a run that is killed finds what it has learned; of this run alone.
        progress: told of frames.

    Returns:
        The model. ``lost_share`` says what part of the details' energy its components do not hold.

    Raises:
        TopologyError: vertices of frames are in another order.
        ValueRangeError: NaN.
        AlignmentError: frames of another unit.
        FileFormatError: the disk is full.
    """
    progress = silent if progress is None else progress
    checked_count("rank", rank, 1)
    frames, faces, sequences, colors = (
        performance.frames,
        performance.faces,
        performance.sequences,
        performance.colors,
    )
    neutral = performance.neutral.detach().float()
    progress("preparing the mesh")
    patches = grow_patches(faces, len(neutral), patch_size, seed)
    encoder = make_encoder(neutral, faces, patches, settings.wavelength, settings.detail)
    key = content_key(
        "enhancement/2",
        neutral=neutral,
        faces=faces,
        patches=patches,
        wavelength=settings.wavelength,
        detail=settings.detail,
    )
    folder = None if folder is None else Path(folder)
    size = 3 * len(neutral) if settings.detail == "displacements" else 9 * len(faces)
    learned = learn_frames(frames, performance.coarse, encoder, rank, size, key, folder, progress)
    warn_without_neutral(learned.motion)
    marks = performance.landmarks
    regions = regions_of_motion(learned.motion, patches, neutral, faces, region_count, marks, seed=seed)
    hue = None if colors is None else StreamingBasis(3 * len(neutral), min(_COLOR_RANK, len(frames)))
    sizes = EnhancementSizes(
        len(neutral),
        len(faces),
        learned.features.shape[1],
        len(frames),
        len(learned.basis.components),
        0 if hue is None else hue.rank,
    )
    model = EnhancementModel(
        sizes,
        regions.names,
        regions.voluntary.tolist(),
        settings,
        learned.basis.lost_share,
        performance.coarse is not None,
    )
    model.neutral, model.faces, model.patches = neutral.clone(), faces.clone(), patches
    model.region_weights, model.sequences = regions.weights.float(), sequences.clone()
    model.database_features = learned.features
    model.components, model.coefficients = learned.basis.components, learned.basis.coefficients
    progress("comparing the sequences")
    projection = model.matching_projection()
    model.limits = projection.limits(sequences).to(model.limits)
    if model.keeps_input:  # what the smooth part lacks is mostly motion, of which the map always counts whole
        products = region_products(model.components, encoder.detail.site_weights(model.vertex_weights))
        shares = map_shares(projection, model.coefficients, model.map_reach(), products, sequences)
        model.map_shares = shares.to(model.map_shares)
    if hue is not None and colors is not None:
        model.mean_color = colors.float().mean(0)
        for some in colors.split(32):
            hue.add((some.float() - model.mean_color).transpose(1, 2).flatten(1).contiguous())
        found = hue.finished()
        model.color_components[: len(found.components)] = found.components
        model.color_coefficients[:, : found.coefficients.shape[1]] = found.coefficients
    return model.eval()

"""The accuracy of a classifier: by cross-validation over frames, and against the labels of other performers."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchface.capture.action_units import GROUPS, RegionGroup, RegionVideo, TrainingSettings
from torchface.capture.action_units.classifier import DEFAULT_TRAINING, GroupClassifier, group_regions
from torchface.capture.action_units.classifier_training import (
    check_training,
    group_features,
    label_group,
    merged_videos,
    principal_components,
)
from torchface.capture.action_units.one_vs_one_svm import OneVsOne
from torchface.errors import ShapeError, ValueRangeError
from torchface.io.action_labels import ActionLabels

Split = Literal["frames", "repetitions", "performers"]


def cross_validation(
    videos: Sequence[RegionVideo],
    labels: Sequence[ActionLabels],
    groups: Sequence[RegionGroup] = GROUPS,
    settings: TrainingSettings = DEFAULT_TRAINING,
    folds: int = 5,
    split: Split = "frames",
) -> dict[str, float]:
    """The fraction of frames in the right class of unit and intensity, by group of regions.

    Args:
        folds: into how many parts the frames are split; each is left out once.
        split: ``frames`` draws frames at random, as is usual; ``repetitions`` leaves whole repetitions out, so that no
            frame is tested with its neighbours; ``performers`` whole videos, so that none is tested with their own.
    """
    check_training(videos, labels, groups)
    names = group_regions(groups)
    patterns, rest = merged_videos(videos, names)
    fold = _folds(labels, folds, split, settings.seed)
    if bool((fold == fold[0]).all()):
        raise ValueRangeError(
            f"folds: found one part of {split} to leave out, expected two at least: perform action units twice, or "
            "train without cross-validation (--folds 0)"
        )
    scores = {}
    for group in groups:
        own = patterns[:, [names.index(name) for name in group.regions]]
        _, classes = label_group(own, labels, group, settings)
        still = rest[:, [names.index(name) for name in group.regions]]
        samples = group_features(GroupClassifier(group, own.shape[-1], 1, 2), own, still)
        right = torch.zeros(len(samples), dtype=torch.bool)
        for number in range(folds):
            out = fold == number
            right[out] = _predicted(samples, classes, out, settings) == classes[out]
        scores[group.name] = float(right.float().mean())
    return scores


def _predicted(samples: Tensor, classes: Tensor, out: Tensor, settings: TrainingSettings) -> Tensor:
    """Classes of the frames left out, learned from the others."""
    present, inner = classes[~out].unique(return_inverse=True)
    if len(present) == 1:
        return present.expand(int(out.sum()))
    mean = samples[~out].double().mean(0)
    components, deviations = principal_components(samples[~out], mean, settings.variance)
    reduced = (samples - mean.float()) @ components.T / deviations
    machine = OneVsOne(len(present), len(components)).fit(reduced[~out], inner, settings.penalty)
    return present[machine(reduced[out]).argmax(1)]


def _folds(labels: Sequence[ActionLabels], folds: int, split: Split, seed: int) -> Tensor:
    """Which part each frame of all videos belongs to, (T,)."""
    total = sum(own.frames for own in labels)
    generator = torch.Generator().manual_seed(seed)
    if split == "frames":
        return torch.randperm(total, generator=generator) % folds
    if split == "performers":
        return torch.cat([torch.full((own.frames,), number % folds) for number, own in enumerate(labels)])
    fold = torch.zeros(total, dtype=torch.int64)
    start = 0
    for own in labels:
        counts: dict[tuple[str, ...], int] = {}
        stretches = sorted(own.performed, key=lambda stretch: stretch.first)
        ends = [stretch.last for stretch in stretches]
        for i, stretch in enumerate(stretches):
            counts[stretch.units] = counts.get(stretch.units, -1) + 1
            # The rest before a repetition goes with it.
            first = ends[i - 1] if i else 0
            fold[start + first : start + stretch.last] = counts[stretch.units] % folds
        start += own.frames
    return fold


def labelled_intensities(
    video: RegionVideo,
    labels: ActionLabels,
    groups: Sequence[RegionGroup] = GROUPS,
    settings: TrainingSettings = DEFAULT_TRAINING,
) -> Tensor:
    """Intensities (T,A) from a video's own labels and the clustering of its frames: the truth of a test."""
    intensities = []
    for group in groups:
        own = video.patterns[:, [video.names.index(name) for name in group.regions]]
        table, classes = label_group(own, [labels], group, settings)
        intensities.append(table[classes])
    return torch.cat(intensities, dim=1)


def level_agreement(found: Tensor, truth: Tensor, levels: int = 4) -> dict[str, float]:
    """How well intensities agree with the truth.

    Args:
        found: (T,A) in [0,1], of a classifier.
        truth: (T,A) in [0,1].
        levels: of intensity, rest included; both are rounded to them.

    Returns:
        ``exact`` and ``within_one``: the fraction of frames in which every unit is at the true level, or at most one
        level from it; ``active_within_one``: the same over frames in which a unit is at level 1 at least in truth.
    """
    if found.shape != truth.shape or found.ndim != 2:
        raise ShapeError(f"intensities: found {tuple(found.shape)} and {tuple(truth.shape)}, expected (T,A) twice")
    own, true = (found * (levels - 1)).round(), (truth * (levels - 1)).round()
    difference = (own - true).abs().amax(1)
    active = (true > 0).any(1)
    return {
        "exact": float((difference == 0).float().mean()),
        "within_one": float((difference <= 1).float().mean()),
        "active_within_one": float((difference[active] <= 1).float().mean()),
    }

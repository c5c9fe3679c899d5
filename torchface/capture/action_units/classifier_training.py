"""Training of a classifier of action units from performed ones."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from torchface.capture.action_units.classifier import (
    ActionUnitClassifier,
    GroupClassifier,
    GroupSize,
    TrainingSettings,
    check_groups,
    group_regions,
)
from torchface.capture.action_units.painted_regions import RegionGroup
from torchface.capture.action_units.region_video import RegionVideo
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.io.action_labels import ActionLabels
from torchface.progress import Progress, silent

_CHUNK = 256
_CONTROL = 5  # of local warps: control points a side
_REST_FRAMES = 2  # at either end of a repetition


def fit_classifier(
    videos: Sequence[RegionVideo],
    labels: Sequence[ActionLabels],
    groups: Sequence[RegionGroup],
    settings: TrainingSettings,
    progress: Progress | None,
) -> ActionUnitClassifier:
    """The classifier of :meth:`ActionUnitClassifier.fit`, which says what the arguments are."""
    progress = progress or silent
    check_training(videos, labels, groups)
    size = videos[0].patterns.shape[-1]
    names = group_regions(groups)
    patterns, rest = merged_videos(videos, names)
    sizes, parts = [], []
    for group in groups:
        progress(f"{group.name}: labelling {len(patterns)} frames")
        own = patterns[:, [names.index(name) for name in group.regions]]
        table, classes = label_group(own, labels, group, settings)
        still = rest[:, [names.index(name) for name in group.regions]]
        part = _fit_group(group, (own, still), (table, classes), settings, progress)
        sizes.append(GroupSize(len(part.components), len(part.intensities)))
        parts.append(part)
    model = ActionUnitClassifier(groups, sizes, size)
    for target, part in zip(model.group_classifiers(), parts, strict=True):
        target.load_state_dict(part.state_dict())
    model.neutral.copy_(videos[0].neutral[[videos[0].names.index(name) for name in names]])
    return model.eval()


def merged_videos(videos: Sequence[RegionVideo], names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Regions of all videos one after the other, and each frame's performer at rest, (T,R,h,w) twice.

    The second is expanded, not copied, for a single video.
    """
    patterns, rest = [], []
    for video in videos:
        rows = [video.names.index(name) for name in names]
        patterns.append(video.patterns[:, rows])
        rest.append(video.rest[rows].expand(len(video.patterns), -1, -1, -1))
    return torch.cat(patterns), rest[0] if len(rest) == 1 else torch.cat(rest)


def label_group(
    patterns: Tensor, labels: Sequence[ActionLabels], group: RegionGroup, settings: TrainingSettings
) -> tuple[Tensor, Tensor]:
    """Intensities of the group's units in each class, (C,A), the first of which is rest, and the class of every frame,
    (T,) int64: a set of units and a level; of regions (T,G,h,w) of all videos.

    Intensities are clustered for each performer and set of units, so a performer's strongest frames are the highest
    level.
    """
    classes = torch.zeros(len(patterns), dtype=torch.int64)
    rows: list[tuple[float, ...]] = [(0.0,) * len(group.units)]
    class_of: dict[tuple[tuple[str, ...], int], int] = {}
    start = 0
    for own in labels:
        for together in sorted({stretch.units for stretch in own.performed}):
            units = tuple(unit for unit in (*group.units, *group.other_units) if unit in together)
            if not units:
                continue
            frames, at_rest = _frames(own, together, start)
            levels = intensity_levels(patterns[frames], at_rest, settings.levels, settings.seed)
            for level in range(1, settings.levels):
                if (units, level) not in class_of:
                    class_of[units, level] = len(rows)
                    strength = level / (settings.levels - 1)
                    rows.append(tuple(strength if unit in units else 0.0 for unit in group.units))
                classes[frames[levels == level]] = class_of[units, level]
        start += own.frames
    return torch.tensor(rows), classes


def _frames(labels: ActionLabels, together: tuple[str, ...], start: int) -> tuple[Tensor, Tensor]:
    """Frames (n,) of all repetitions of units performed together, and which of them are at rest."""
    frames, at_rest = [], []
    for stretch in labels.performed:
        if stretch.units == together:
            own = torch.arange(stretch.first, stretch.last)
            near = min(_REST_FRAMES, (len(own) - 1) // 2)
            frames.append(start + own)
            at_rest.append((own < stretch.first + max(near, 1)) | (own >= stretch.last - near))
    return torch.cat(frames), torch.cat(at_rest)


def _fit_group(
    group: RegionGroup,
    shown: tuple[Tensor, Tensor],
    labelled: tuple[Tensor, Tensor],
    settings: TrainingSettings,
    progress: Progress,
) -> GroupClassifier:
    """Of regions and the same at rest, (T,G,h,w) each, and what :func:`label_group` says of them."""
    size, (table, truth) = shown[0].shape[-1], labelled
    probe = GroupClassifier(group, size, 1, 2)
    generator = torch.Generator().manual_seed(settings.seed)
    features = [group_features(probe, *shown)]
    features += [group_features(probe, *shown, settings.warp_amplitude, generator) for _ in range(settings.warps)]
    samples, truth = torch.cat(features), truth.repeat(len(features))
    progress(f"{group.name}: principal components of {samples.shape[1]} features")
    mean = samples.double().mean(0)
    components, deviations = principal_components(samples, mean, settings.variance)
    part = GroupClassifier(group, size, len(components), len(table))
    part.mean.copy_(mean)
    part.components.copy_(components)
    part.deviations.copy_(deviations)
    part.intensities.copy_(table)
    reduced = (samples - part.mean) @ part.components.T / part.deviations
    progress(f"{group.name}: {len(table)} classes of {len(components)} components")
    part.machine.fit(reduced, truth, settings.penalty)
    return part


def group_features(
    part: GroupClassifier,
    patterns: Tensor,
    rest: Tensor,
    amplitude: float = 0.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Features (T,D) of a group's regions and those at rest, (T,G,h,w) twice, warped alike if a generator is given."""
    rows = []
    for chunk, still in zip(patterns.split(_CHUNK), rest.split(_CHUNK), strict=True):
        if generator is not None:
            both = local_warps(torch.cat([chunk, still], dim=1), amplitude, generator, alike=2)
            chunk, still = both.chunk(2, dim=1)
        rows.append(part.features(chunk, still))
    return torch.cat(rows)


def principal_components(samples: Tensor, mean: Tensor, variance: float) -> tuple[Tensor, Tensor]:
    """Components (K,D) that explain a fraction of the variance of samples (T,D), and the deviations along them."""
    from sklearn.decomposition import PCA  # takes a second, and only training needs it

    reduction = PCA(svd_solver="covariance_eigh")
    # scikit-learn would also choose K, but then refuses a fraction of 1.
    reduction.fit((samples.double() - mean).numpy())
    explained = torch.from_numpy(reduction.explained_variance_ratio_).cumsum(0)
    kept = min(int((explained < variance).sum()) + 1, len(explained))
    deviations = torch.from_numpy(reduction.explained_variance_[:kept]).clamp(min=1e-12).sqrt()
    return torch.from_numpy(reduction.components_[:kept].copy()).float(), deviations.float()


def check_training(
    videos: Sequence[RegionVideo], labels: Sequence[ActionLabels], groups: Sequence[RegionGroup]
) -> None:
    """Raises where videos and labels do not fit each other or the groups."""
    check_groups(groups)
    if not videos or len(videos) != len(labels):
        raise ShapeError(f"training: found {len(videos)} videos and {len(labels)} labels, expected one each")
    for video, own in zip(videos, labels, strict=True):
        if len(video.patterns) != own.frames:
            raise ShapeError(f"training: found {len(video.patterns)} frames labelled as {own.frames}, expected as many")
        lacking = [name for name in group_regions(groups) if name not in video.names]
        if lacking:
            raise NameMismatchError(f"training: found no region {', '.join(lacking)}, expected those of the groups")
    wanted = [unit for group in groups for unit in group.units]
    alone = {stretch.units[0] for own in labels for stretch in own.performed if len(stretch.units) == 1}
    never = [unit for unit in wanted if unit not in alone]
    if never:
        raise NameMismatchError(
            f"training: {', '.join(never)} is never performed alone; expected at least one repetition of every unit of "
            f"the groups ({', '.join(wanted)}), or groups without it"
        )
    wanted += [unit for group in groups for unit in group.other_units]
    unknown = sorted({unit for own in labels for unit in own.units} - set(wanted))
    if unknown:
        raise NameMismatchError(f"training: {', '.join(unknown)} is performed, but no group of regions shows it")


def intensity_levels(images: Tensor, at_rest: Tensor, levels: int = 4, seed: int = 0) -> Tensor:
    """The level of each frame of one action, (T,) int64 from 0, which is rest, to ``levels - 1``.

    The first principal component gives one number a frame; k-means clusters these into ``levels``, which are
    ordered by how far they lie from the frames at rest.

    Args:
        images: one region, or several side by side, in every repetition of the action, (T,...).
        at_rest: frames just before and after a repetition, (T,) bool.

    Source: thesis 4.1.11.
    """
    if at_rest.shape != images.shape[:1] or not bool(at_rest.any()):
        raise ShapeError(f"at_rest: found {int(at_rest.sum())} of {tuple(at_rest.shape)}, expected (T,) with some")
    mode = main_mode(images)
    if len(mode.unique()) < levels:
        raise ValueRangeError(
            f"intensity levels: found {len(mode.unique())} different frames, expected at least {levels} to cluster"
        )
    from sklearn.cluster import KMeans  # takes a second, and only training needs it

    clusters = KMeans(levels, n_init=10, random_state=seed).fit(mode[:, None].numpy())
    centres = torch.from_numpy(clusters.cluster_centers_[:, 0]).double()
    order = (centres - mode[at_rest].median()).abs().argsort()
    rank = torch.empty_like(order)
    rank[order] = torch.arange(levels)
    return rank[torch.from_numpy(clusters.labels_).long()]


def main_mode(images: Tensor) -> Tensor:
    """Scores (T,) float64 of frames (T,...) along their first principal component."""
    samples = images.flatten(1).double()
    centred = samples - samples.mean(0)
    values, vectors = torch.linalg.eigh(centred @ centred.T)
    first = vectors[:, -1] * values[-1].clamp(min=0).sqrt()
    # The sign of an eigenvector is arbitrary: the same frames give the same scores.
    return first * torch.where(first[first.abs().argmax()] < 0, -1.0, 1.0)


def local_warps(images: Tensor, amplitude: float, generator: torch.Generator, alike: int = 1) -> Tensor:
    """Regions (T,R,h,w), each frame and region warped by a smooth field of its own.

    Args:
        amplitude: standard deviation of the control points' displacement, pixels.
        alike: into how many parts the regions fall that get the same field, region by region.

    Source: thesis 4.1.14.
    """
    frames, regions, height, width = images.shape
    control = torch.randn(frames, regions // alike, 2, _CONTROL, _CONTROL, generator=generator)
    control = control.repeat(1, alike, 1, 1, 1).flatten(0, 1)
    field = interpolate(amplitude * control, (height, width), mode="bicubic", align_corners=True)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    places = torch.stack([x, y], dim=-1) + field.permute(0, 2, 3, 1)
    grid = 2 * places / torch.tensor([width, height]) - 1
    warped = grid_sample(
        images.reshape(frames * regions, 1, height, width), grid, padding_mode="border", align_corners=False
    )
    return warped.view_as(images)

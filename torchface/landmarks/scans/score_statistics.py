"""Statistics of a filter's scores at its landmark in other images, and elsewhere: two Gaussians a filter."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.landmarks.scans.detector_settings import DetectorSettings
from torchface.landmarks.scans.hog import similarity, unit_windows
from torchface.progress import Progress, silent

_NEVER = 2.0  # no cosine is that large


@dataclass(frozen=True, eq=False)
class ScoreStatistics:
    """Scores of L·M filters, L landmarks of M images each, in M images."""

    # good, bad: mean and standard deviation near the landmark and elsewhere, (L,M,2)
    good: Tensor
    bad: Tensor
    best: Tensor  # the R best scores in every image, (M,L,M,R); 0 in the image that the filter comes from
    places: Tensor  # where those are, rows of the flattened map


def best_scores(scores: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Of scores (M,P): the best of each row (M,R), and their places."""
    best = scores.topk(min(count, scores.shape[1]), dim=1)
    return best.values, best.indices


def score_statistics(
    maps: Sequence[Tensor],
    filters: Tensor,
    landmarks: Tensor,
    settings: DetectorSettings,
    progress: Progress | None = None,
) -> ScoreStatistics:
    """Scores every filter (L,M,bins,side,side) in all images but its own; landmarks (M,L,2) are pixels, NaN if
    unknown. Source: thesis 3.2.2."""
    progress = progress or silent
    count, names = landmarks.shape[:2]
    sums = torch.zeros(2, names, count, 3, dtype=torch.float64)
    height, width = maps[0].shape[1:]
    best = torch.zeros(count, names, count, min(settings.matches, height * width))
    places = torch.zeros(best.shape, dtype=torch.int64)
    rows, columns = (settings.hog.positions(torch.arange(n)) for n in (height, width))
    for i, cells in enumerate(maps):  # the scores of one image are 100 MB
        described = unit_windows(cells[None], settings.hog)
        others = torch.arange(count) != i
        for k in range(names):
            if not bool(torch.isfinite(landmarks[i, k]).all()):
                continue
            scores = similarity(described, filters[k, others])[0]
            best[i, k, others], places[i, k, others] = best_scores(scores, settings.matches)
            squared = (rows[:, None] - landmarks[i, k, 1]) ** 2 + (columns - landmarks[i, k, 0]) ** 2
            near = squared.flatten() <= settings.good_radius**2
            kept = scores >= settings.similarity_threshold
            for which, region in enumerate((near, ~near)):
                chosen = torch.where(kept & region, scores, 0.0)
                moments = [(kept & region).sum(1), chosen.sum(1), chosen.square().sum(1)]
                sums[which, k, others] += torch.stack([m.double() for m in moments], dim=-1)
        progress("scoring images", i + 1, count)
    number, total, squares = sums.unbind(-1)
    mean = total / number.clamp(min=1)
    spread = (squares / number.clamp(min=1) - mean**2).clamp(min=1e-4).sqrt()
    # A filter that never matched where it should have: nothing it finds counts as good.
    mean[0][number[0] == 0] = _NEVER
    good, bad = torch.stack([mean, spread], dim=-1).float().unbind(0)
    return ScoreStatistics(good, bad, best, places)

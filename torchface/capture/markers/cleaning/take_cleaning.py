"""Defects of a marker take, found, named, and repaired where that is safe; the raw take is not changed."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.markers.cleaning.label_swaps import cycled_back, find_swaps, swapped_back, whole_take_exchanges
from torchface.capture.markers.cleaning.robust_prediction import Prediction, predict_markers
from torchface.capture.markers.given_markers import markers_of
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.capture.markers.take_smoothing import WholeTakeSolver
from torchface.take import Take, Track

_SPIKE_SECONDS, _GAP_SECONDS = 0.1, 0.25
_DISPLACED_FRACTION = 0.7
_MIN_REPORTED_GAP = 2
_BACK = "swapped back"
_BY_SEVERITY = ("swap", "displaced", "spike", "gap")


@dataclass(frozen=True)
class Defect:
    """One defect.

    Args:
        kind: ``swap``, ``spike``, ``displaced`` (it drifts, has fallen off, or carries another's label) or ``gap``.
        labels: the markers; two for a swap, or more that changed round, each called like the next.
        first, last: rows of the take, ``last`` included.
        size: largest distance from where the rig expects the marker, millimetres; 0 for a gap.
        action: what was done: ``swapped back``, ``masked``, ``filled`` or ``left``.

    Example:
        >>> Defect("swap", ("M041", "M042"), 150, 189, 12.0, "swapped back").labels
        ('M041', 'M042')
    """

    kind: str
    labels: tuple[str, ...]
    first: int
    last: int
    size: float
    action: str


@dataclass(frozen=True, eq=False)
class Cleanup:
    """Defects and repairs of a take.

    Args:
        take: the repaired take: labels swapped back, bad samples NaN, gaps left open.
        filled: the same with short gaps closed by the rig's own prediction: for solving frame by frame.
        defects: in order of their first frame.
        masked: samples that were seen and are not used, (T,M) bool, in the order of the take's markers.

    Example:
        >>> from torchface import zoo
        >>> solver = zoo.get_model("marker_solver")
        >>> markers = solver.points(torch.zeros(60, len(solver.names))).float()
        >>> markers[30:34, 7] = torch.nan
        >>> cleanup = clean_take(solver, Take(60.0, markers=Track(solver.labels, markers)))
        >>> [bool(take.markers.values.isnan().any()) for take in (cleanup.take, cleanup.filled)]
        [True, False]
    """

    take: Take
    filled: Take
    defects: tuple[Defect, ...]
    masked: Tensor

    def table(self, gaps: bool = True) -> list[tuple[str, ...]]:
        """Rows for people to read, gravest kind first: kind, markers, frames by the take's numbers, size, action."""
        return [
            (
                defect.kind,
                " ↔ ".join(defect.labels),
                self.span(defect),
                f"{defect.size:.1f} mm" if defect.size else "",
                defect.action,
            )
            for defect in sorted(self.defects, key=lambda defect: _BY_SEVERITY.index(defect.kind))
            if gaps or defect.kind != "gap"
        ]

    def span(self, defect: Defect) -> str:
        """The frames of a defect by the take's numbers, as a text."""
        return f"{int(self.take.numbers[defect.first])}–{int(self.take.numbers[defect.last])}"

    def summary(self) -> str:
        """How many of each."""
        counts = Counter(defect.kind for defect in self.defects)
        words = {"displaced": "displacement"}
        found = ", ".join(
            f"{counts[kind]} {words.get(kind, kind)}{'s' * (counts[kind] > 1)}" for kind in _BY_SEVERITY if counts[kind]
        )
        share = 100 * float(self.masked.double().mean()) if self.masked.numel() else 0.0
        return f"{found or 'nothing wrong'} found; {share:.2f} % of the samples rejected"


def clean_take(solver: MarkerSolver, take: Take, slip: bool = False) -> Cleanup:
    """Finds swapped labels, spikes, markers that drift or fell off, and gaps; repairs what is safe.

    The rig predicts every marker from those that agree. Labels that stand at each other's place are swapped back;
    samples that still do not fit are masked; short gaps are filled, in ``filled`` only, by the marker's place on the
    rig after batch smoothing (with slip: from its own frame).

    Args:
        solver: rig, attachment, and the take's alignment.
        take: markers matched by label.
        slip: the helmet moves on the head.

    Raises:
        NameMismatchError: the take has no markers, labels that the attachment does not know, or none that it knows.

    Example:
        >>> from torchface import zoo
        >>> solver = zoo.get_model("marker_solver")
        >>> markers = solver.points(torch.zeros(60, len(solver.names))).float()
        >>> markers[30, 7, 2] += 20.0
        >>> cleanup = clean_take(solver, Take(60.0, markers=Track(solver.labels, markers)))
        >>> [(defect.kind, defect.labels, defect.first) for defect in cleanup.defects]
        [('spike', ('M008',), 30)]
    """
    track = markers_of(take)
    raw = solver.arrange(track).double()
    raw[torch.isnan(raw).any(-1)] = torch.nan
    alignment = solver.alignment
    seen = solver.in_rig_space(raw)
    first = predict_markers(solver, seen, slip)
    labels = solver.labels
    cycles = whole_take_exchanges(seen, first)
    defects = [
        Defect(
            "swap", tuple(labels[m] for m in cycle), 0, len(raw) - 1, _largest(first.distance[:, list(cycle)]), _BACK
        )
        for cycle in cycles
    ]
    if cycles:
        raw, seen = cycled_back(raw, cycles), cycled_back(seen, cycles)
        first = predict_markers(solver, seen, slip)
    swaps = find_swaps(seen, first, take.fps)
    repaired = swapped_back(seen, swaps)
    prediction = predict_markers(solver, repaired, slip) if swaps else first
    defects += [
        Defect(
            "swap",
            (labels[swap.markers[0]], labels[swap.markers[1]]),
            swap.first,
            swap.last - 1,
            _largest(first.distance[swap.first : swap.last, list(swap.markers)]),
            _BACK,
        )
        for swap in swaps
    ]
    bad, others = _displaced(prediction, labels, take.fps)
    lost = torch.tensor([any(d.kind == "displaced" and label in d.labels for d in others) for label in labels])
    if bool(lost.any()):
        # A slow drift biases the weights at first: only the other markers show when it began.
        prediction = predict_markers(solver, repaired, slip, lost)
        bad, others = _displaced(prediction, labels, take.fps)
    defects += others
    masked = repaired.clone()
    masked[bad] = torch.nan
    # A marker that the take lacks has no gaps.
    present = [i for i, label in enumerate(labels) if label in track.names]
    expected = _expected_alone(prediction, masked) if slip else _expected_over_time(solver, masked, take)
    filled, gaps = _fill(masked, bad, expected, labels, present, take.fps)
    defects += gaps
    back = alignment.inverse().apply if alignment is not None else (lambda points: points)
    column = [labels.index(name) for name in track.names]

    def delivered(points: Tensor, changed: Tensor) -> Take:
        # Unchanged samples come back bit for bit.
        values = torch.where(changed[..., None], back(points), swapped_back(raw, swaps))[:, column]
        values[torch.isnan(points).any(-1)[:, column]] = torch.nan
        return replace(take, markers=Track(track.names, values.to(track.values.dtype), track.confidence))

    closed = torch.isnan(masked).any(-1) & ~torch.isnan(filled).any(-1)
    clean = delivered(masked, torch.zeros_like(bad))
    order = sorted(defects, key=lambda defect: (defect.first, defect.kind, defect.labels))
    return Cleanup(clean, delivered(filled, closed), tuple(order), bad[:, column])


def _displaced(prediction: Prediction, labels: Sequence[str], fps: float) -> tuple[Tensor, list[Defect]]:
    """Samples to mask (T,M), and their runs by name: short ones are spikes.

    Runs of one marker with few inliers between them are one: it drifts or fell off, and the frames between are masked
    too.
    """
    outlier, seen = prediction.outliers, ~torch.isnan(prediction.distance)
    bad = outlier.clone()
    defects = []
    longest = max(1, round(_SPIKE_SECONDS * fps))
    for m in outlier.any(0).nonzero()[:, 0].tolist():
        for first, last in _merged(_runs(outlier[:, m]), outlier[:, m], seen[:, m]):
            short = last - first < longest
            if not short:
                bad[first : last + 1, m] = seen[first : last + 1, m]
            size = _largest(prediction.distance[first : last + 1, m])
            defects.append(Defect("spike" if short else "displaced", (labels[m],), first, last, size, "masked"))
    return bad, defects


def _merged(runs: list[tuple[int, int]], outlier: Tensor, seen: Tensor) -> list[tuple[int, int]]:
    """Runs joined to the one before where, of the samples seen from its start to the end, most are outliers."""
    merged: list[tuple[int, int]] = []
    for first, last in runs:
        if merged:
            start, end = merged[-1]
            fraction = float(outlier[start : last + 1].sum()) / max(int(seen[start : last + 1].sum()), 1)
            if fraction >= _DISPLACED_FRACTION or (first - end <= 2 and fraction >= 0.5):
                merged[-1] = (start, last)
                continue
        merged.append((first, last))
    return merged


def _fill(
    seen: Tensor, bad: Tensor, expected: Tensor, labels: Sequence[str], present: Sequence[int], fps: float
) -> tuple[Tensor, list[Defect]]:
    """Short gaps closed, between frames that show the marker; those of two frames or more named unless masked."""
    filled, defects = seen.clone(), []
    longest = max(1, round(_GAP_SECONDS * fps))
    missing = torch.isnan(seen).any(-1)
    for m in present:
        for first, last in _runs(missing[:, m]):
            inside = first > 0 and last + 1 < len(seen)
            safe = inside and last - first < longest and bool(torch.isfinite(expected[first : last + 1, m]).all())
            if safe:
                filled[first : last + 1, m] = expected[first : last + 1, m]
            if last - first + 1 >= _MIN_REPORTED_GAP and not bool(bad[first : last + 1, m].all()):
                defects.append(Defect("gap", (labels[m],), first, last, 0.0, "filled" if safe else "left"))
    return filled, defects


def _expected_alone(prediction: Prediction, seen: Tensor) -> Tensor:
    """Markers (T,M,3) predicted from their own frame; NaN in a frame that shows none."""
    empty = torch.isnan(seen).any(-1).all(1)
    return torch.where(empty[:, None, None], torch.nan, prediction.expected)


def _expected_over_time(solver: MarkerSolver, seen: Tensor, take: Take) -> Tensor:
    """Markers (T,M,3) on the rig after batch smoothing, in rig space: neighbouring frames bridge a gap."""
    if bool(torch.isnan(seen).any(-1).all()):
        return solver.rest.double().expand_as(seen)
    alignment = solver.alignment
    markers = seen if alignment is None else alignment.inverse().apply(seen)
    weights = WholeTakeSolver(solver)(markers, take.fps, take.seconds)
    on_rig = solver.points(weights)
    return on_rig + (seen - on_rig).nanmedian(0).values.nan_to_num(0.0)


def _runs(mask: Tensor) -> list[tuple[int, int]]:
    """First and last row of each run of True in (T,)."""
    padded = torch.cat([mask.new_zeros(1), mask, mask.new_zeros(1)]).int()
    change = padded[1:] - padded[:-1]
    starts, ends = (change == 1).nonzero()[:, 0], (change == -1).nonzero()[:, 0] - 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def _largest(distance: Tensor) -> float:
    return float(distance.nan_to_num(0.0).max())

"""The solution of a take's markers: aligned, cleaned, freed of slip and of what is left at rest, then solved."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture import (
    HelmetSolver,
    HybridSolver,
    MarkerSolver,
    WholeTakeSolver,
    align_take,
    clean_take,
    rest_residual,
)
from torchface.capture.markers import Cleanup, FitCheck, HelmetMotion
from torchface.capture.markers.helmet_motion import steady_take
from torchface.capture.markers.marker_solver import RIDGE, SPARSITY
from torchface.escaped_text import listed
from torchface.evaluation.mesh_errors import marker_offsets
from torchface.geometry.similarity import Similarity
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track, empty_frames
from torchface.workflows.marker_input import scale_warnings
from torchface.workflows.solve.head_camera import Predicted, video_warnings
from torchface.workflows.solve.take_check import (
    check_coverage,
    check_explained,
    check_head,
    fit_warnings,
    label_warnings,
    neutral_warnings,
)

# A take is cleaned again where its alignment moves a site farther after the first cleaning, mm.
_REALIGNED = 0.1
_MOST = 0.8  # of the samples, below which a take shows too little
# Millimetres of a coordinate; a usual weight; how much of it is left open of a shape that markers hardly see.
_LEAST_NOISE, _USUAL_WEIGHT, _UNSEEN = 0.1, 0.3, 0.8
_STRAY = 8.0  # times the median distance: noise stays below it, spikes and exchanged labels do not
_SHOWN_DEFECTS = 12


@dataclass(frozen=True)
class SolveSettings:
    """How a take is solved."""

    # A frame with the face at rest, by which the take is aligned with the rig; by the whole take if absent and align.
    neutral: int | None = None
    # Align the take with the rig; otherwise its markers are in the rig's space already, unless neutral is given.
    align: bool = False
    subtract_rest: bool = True  # subtract what is left at rest between markers and sites of an aligned take
    slip: bool = False  # the helmet moves on the head
    clean: bool = False  # find and repair swapped labels, spikes and markers that drift or fell off
    # Every frame on its own; otherwise the weights of the whole take at once, smooth over time.
    frame_by_frame: bool = False
    # sparsity, ridge: see MarkerSolver
    sparsity: float = SPARSITY
    ridge: float = RIDGE
    insist: bool = False  # solve what the rig does not explain, too
    free_scale: bool = True  # an alignment estimates the take's scale; otherwise it is 1


@dataclass(frozen=True, eq=False)
class Solution:
    """The solution of a take's markers."""

    rig: BlendshapeRig
    take: Take
    markers: Tensor  # as the solve used them, (T,M,3), in rig space, without slip, bad samples NaN
    attachment: Attachment  # the sites, with what was subtracted at rest; of the take's markers
    alignment: Similarity | None = None  # marker space to rig space, where one was estimated
    motion: HelmetMotion | None = None  # the helmet's, where it was asked for
    cleanup: Cleanup | None = None  # what was wrong with the take, where that was asked for
    warnings: tuple[str, ...] = ()  # what the user should know before they use the weights
    # What a warning says of labels or sites; what is subtracted at rest hides that in the distances.
    misplaced: str = ""

    @property
    def weights(self) -> Tensor:
        """The solved weights, (T,N)."""
        assert self.take.weights is not None
        return self.take.weights.values[..., 0]

    @cached_property
    def offsets(self) -> Tensor:
        """From each marker's site on the solved face to the marker, (T,M,3), millimetres; NaN where not seen."""
        residual = self.attachment.residual
        markers = self.markers if residual is None else self.markers - residual.to(self.markers)
        return marker_offsets(self.rig, self.attachment, self.weights, markers)

    @cached_property
    def fit(self) -> FitCheck:
        """How far the markers lie from the solved face, beside the size of the sites."""
        sites = self.attachment.on(self.rig.neutral.faces, self.rig.vertices.detach())
        radius = float((sites - sites.mean(0)).norm(dim=-1).mean())
        return FitCheck(float(self.offsets.norm(dim=-1).nanmedian()), radius)

    @cached_property
    def stray_warnings(self) -> list[str]:
        """The frames in which a marker lies far from the solved face; nothing where all lie near."""
        limit = max(self.fit.limit, _STRAY * self.fit.distance)
        distance = self.offsets.norm(dim=-1).nan_to_num()
        far = (distance > limit).any(1).nonzero()[:, 0]
        if not len(far):
            return []
        frame, marker = divmod(int(distance.argmax()), distance.shape[1])
        worst = f"{float(distance[frame, marker]):.4g} mm ({(self.attachment.labels or ())[marker]})"
        advice = "they can be wrong there" if self.cleanup else "add --clean"
        return [
            f"{_frames(self.take, far)} with a marker more than {limit:.2g} mm from the solved face, at worst {worst}; "
            f"spikes and exchanged labels spoil the weights of the frames around them, too: {advice}"
        ]

    @cached_property
    def unseen(self) -> tuple[str, ...]:
        """Shapes whose weight in a frame these markers, with the error that they have, determine hardly better than
        nothing does."""
        sites = self.attachment.on(self.rig.neutral.faces, self.rig.deltas.detach().double()).flatten(1)
        noise = max(float(self.rmse.nanmedian()) / 3**0.5, _LEAST_NOISE)
        precision = sites @ sites.T / noise**2
        precision.diagonal().add_(1 / _USUAL_WEIGHT**2)
        deviation = torch.linalg.inv(precision).diagonal().sqrt()
        names = zip(self.rig.names, (deviation > _UNSEEN * _USUAL_WEIGHT).tolist(), strict=True)
        return tuple(name for name, hidden in names if hidden)

    @property
    def rmse(self) -> Tensor:
        """Marker RMSE a frame, (T,), millimetres."""
        return self.offsets.square().sum(-1).nanmean(-1).sqrt()


@dataclass(frozen=True, eq=False)
class SolveReport:
    """The report of a solve."""

    solution: Solution
    seen: float  # fraction of the samples of the attachment's markers that were seen
    seconds: float
    predicted: Predicted | None = None  # what the head camera saw, where there was a video
    warnings: tuple[str, ...] = ()  # what the user should know before they use the weights
    notes: tuple[str, ...] = ()  # what else there is to say of the files, and what was streamed

    def verdict(self) -> str:
        """Whether the weights are to be used, in a line."""
        fit = self.solution.fit
        lie = (
            f"the markers lie {fit.distance:.2g} mm from the solved face (median; at most {fit.usual:.2g} mm is usual "
            f"for these sites"
        )
        seen = f"{100 * self.seen:.1f} % of the markers' samples were seen"
        if fit.doubtful:
            return f"result: poor, {lie}; are rig and sites this person's own, and the labels right?); {seen}"
        if fit.noisy:
            why = "more noise than a stage's, another head's rig, or a take that needs --clean or --slip?"
            return f"result: partly usable, {lie}; {why}); {seen}"
        if self.solution.misplaced:
            return f"result: partly usable, {self.solution.misplaced}, see the warning; {lie}); {seen}"
        if self.solution.stray_warnings:
            return f"result: partly usable, single frames are wrong, see the warning; {lie}); {seen}"
        if self.seen < _MOST:
            return f"result: partly usable, {seen}, and where they are missing weights are guessed; {lie})"
        return f"result: good, {lie}); {seen}"

    def lines(self) -> list[str]:
        """For people to read."""
        solution, rmse = self.solution, self.solution.rmse
        frames, worst = len(rmse), float(rmse.nan_to_num().max())
        lines = [self.verdict(), *(f"warning: {warning}" for warning in self.warnings), *self.notes]
        lines.append(f"{frames} frames at {solution.take.rate}")
        if solution.alignment is not None:
            x, y, z = solution.alignment.translation[0].tolist()
            scale = float(solution.alignment.scale[0])
            lines.append(f"alignment: scale {scale:.4f}, moved by ({x:.1f}, {y:.1f}, {z:.1f}) mm")
        lines.append(
            f"marker RMSE: median {float(rmse.nanmedian()):.3f} mm, "
            f"95th percentile {float(rmse.nanquantile(0.95)):.3f} mm, worst {worst:.3f} mm"
        )
        filmed = () if self.predicted is None else self.predicted.gamma.names
        unseen = [name for name in solution.unseen if name not in filmed]
        if unseen:
            lines.append(f"shapes that these markers hardly see, whose weights are uncertain: {listed(unseen)}")
        lines.append(f"solved in {self.seconds:.2f} s, {1000 * self.seconds / max(frames, 1):.3f} ms a frame")
        if solution.motion is not None:
            lines.append(f"helmet or head: moved by up to {solution.motion.extent()}; not in the weights")
        if solution.cleanup is not None:
            lines.append(f"cleanup: {solution.cleanup.summary()}")
            rows = solution.cleanup.table(gaps=False)
            lines.extend(f"  {' '.join(cell for cell in row if cell)}" for row in rows[:_SHOWN_DEFECTS])
            if len(rows) > _SHOWN_DEFECTS:
                lines.append(f"  and {len(rows) - _SHOWN_DEFECTS} more; the report (--report DIR) lists all")
        if self.predicted is not None:
            active = (self.predicted.gamma.values > 0).any(2)
            shapes = ", ".join(self.predicted.gamma.names) or "no shape"
            lines.append(f"video: predicts {shapes} in {100 * float(active.any(1).float().mean()):.0f} % of the frames")
            lines.extend(f"  {note}" for note in self.predicted.notes)
        return lines


def solve_markers(
    rig: BlendshapeRig,
    attachment: Attachment,
    take: Take,
    settings: SolveSettings = SolveSettings(),
    predicted: Predicted | None = None,
    progress: Progress | None = None,
) -> Solution:
    """A take's weights: aligned with the rig, cleaned, freed of slip and of what is left at rest, solved, with what
    a head camera predicted if given."""
    progress = progress or silent
    whole = not settings.frame_by_frame
    warnings = check_coverage(attachment, take, len(rig.names), settings.insist).warnings()

    alignment, head, raw = None, None, take
    if settings.align or settings.neutral is not None:
        progress("aligning the take with the rig")
        if settings.slip:
            raw, head = steady_take(take)
        alignment = align_take(rig, attachment, raw, settings.neutral, settings.insist, settings.free_scale)
        take = _moved(raw, alignment.apply)
    solver = MarkerSolver(rig, attachment, sparsity=settings.sparsity, ridge=settings.ridge)
    fit = check_explained(solver, take, alignment is not None, settings.slip, settings.insist)
    doubts = fit_warnings(fit, alignment is not None, settings.slip)
    warnings += doubts
    warnings += _empty_frame_warnings(take, predicted is None)
    if settings.neutral is not None:
        warnings += neutral_warnings(rig, attachment, raw, settings.neutral, settings.free_scale)

    cleanup = None
    exchanged = [] if settings.clean else label_warnings(solver, take, settings.slip)
    warnings += exchanged
    misplaced = "labels seem to be exchanged" if exchanged else ""
    if settings.clean:
        progress("looking for what is wrong with the take")
        cleanup = clean_take(solver, take, settings.slip)
        if alignment is not None and any(defect.kind != "gap" for defect in cleanup.defects):
            # What was wrong with the take moved its alignment, and the alignment its cleaning.
            repaired = _moved(cleanup.take, alignment.inverse().apply)
            better = align_take(rig, attachment, repaired, settings.neutral, settings.insist, settings.free_scale)
            rest = solver.rest.double()
            if float((better.apply(alignment.inverse().apply(rest)[0]) - rest).norm(dim=-1).max()) > _REALIGNED:
                cleanup = clean_take(solver, _moved(raw, better.apply), settings.slip)
                alignment = better
        take = cleanup.take if whole else cleanup.filled

    progress("solving")
    steady, motion = _without_slip(rig, attachment, take, settings)
    if alignment is not None:
        free = alignment if settings.free_scale else align_take(rig, attachment, steady, insist=True)
        warnings += scale_warnings(float(free.scale[0]), not settings.free_scale, take.extras.get("unit"))
    doubted, astray = check_head(rig, attachment, steady, settings.insist, fit.cause)
    warnings += doubted
    if astray:
        misplaced = misplaced or f"{len(astray)} marker{'s lie' if len(astray) > 1 else ' lies'} off the site"
        warnings.append(
            f"in the whole take markers lie off their sites: {listed(astray)}; they sit elsewhere, or have others' "
            "labels: find the sites (torchface attach), rename or leave them out (--labels)"
        )
    if settings.subtract_rest and alignment is not None:
        attachment = rest_residual(rig, attachment, steady)
        # Sites that are nearer to the markers show the helmet's motion better.
        steady, motion = _without_slip(rig, attachment, take, settings)
        solver = MarkerSolver(rig, attachment, sparsity=settings.sparsity, ridge=settings.ridge)
    curves = () if predicted is None else (predicted.weights, predicted.gamma)
    if predicted is not None and not doubts:  # weights that are wrong themselves say nothing of a video
        warnings += video_warnings(solver.solve_take(steady), predicted)
    if whole:
        solved = WholeTakeSolver(solver).solve_take(steady, *curves)
    else:
        solved = HybridSolver(solver).solve_take(steady, *curves) if curves else solver.solve_take(steady)

    assert steady.markers is not None
    labels = tuple(label for label in attachment.labels or () if label in steady.markers.names)
    markers = steady.markers.select(labels).values
    if cleanup is not None and cleanup.take.markers is not None:  # what was filled in was not seen
        markers = torch.where(torch.isnan(cleanup.take.markers.select(labels).values), torch.nan, markers)
    sites = attachment.select(labels)
    if head is not None and motion is not None and alignment is not None:
        motion = head.moved_by(alignment).after(motion)
    solution = Solution(rig, solved, markers, sites, alignment, motion, cleanup, misplaced=misplaced)
    return replace(solution, warnings=(*warnings, *solution.stray_warnings))


def _moved(take: Take, move: Callable[[Tensor], Tensor]) -> Take:
    """A take whose markers (T,M,3) are moved, in double precision."""
    assert take.markers is not None
    values = take.markers.values
    return replace(take, markers=Track(take.markers.names, move(values.double()).to(values)))


def _without_slip(
    rig: BlendshapeRig, attachment: Attachment, take: Take, settings: SolveSettings
) -> tuple[Take, HelmetMotion | None]:
    """A take in rig space as a steady helmet would have seen it, and the helmet's motion; as it is without slip."""
    if not settings.slip:
        return take, None
    _, motion = HelmetSolver(rig, attachment, None, settings.sparsity, settings.ridge).solve_take(take)
    return _moved(take, motion.undo), motion


def _empty_frame_warnings(take: Take, held: bool = True) -> list[str]:
    """Which frames show no marker; nothing where all show some."""
    empty = empty_frames(take)
    if not len(empty):
        return []
    ends = ", held at the take's ends" if held and not {0, len(take) - 1}.isdisjoint(empty.tolist()) else ""
    return [f"{_frames(take, empty)} show no marker; their weights come from the frames before and after{ends}"]


def _frames(take: Take, rows: Tensor) -> str:
    """Rows of a take (K,) as a text: ``10 frames (120–128, 340)``."""
    rows = take.numbers[rows.cpu()]
    breaks = (rows.diff() > 1).nonzero()[:, 0].tolist()
    firsts, lasts = [0, *(i + 1 for i in breaks)], [*breaks, len(rows) - 1]
    spans = [(int(rows[a]), int(rows[b])) for a, b in zip(firsts, lasts, strict=True)]
    shown = listed(str(a) if a == b else f"{a}–{b}" for a, b in spans)
    return f"{len(rows)} frames ({shown}{' stretches' if shown.endswith('more') else ''})"

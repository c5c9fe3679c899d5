"""From a rig, a marker take and an attachment on disk to weights on disk."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

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
from torchface.capture.markers import HelmetMotion
from torchface.capture.markers.marker_solver import RIDGE, SPARSITY
from torchface.errors import ValueRangeError
from torchface.evaluation import marker_rmse
from torchface.files.whole_files import make_folder
from torchface.geometry.similarity import Similarity
from torchface.io import load_rig, save_animation
from torchface.io.protocols.weight_sender import find_receiver
from torchface.onnx.live_solver import LiveMarkerSolver
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track, empty_frames
from torchface.temporal import OneEuroFilter
from torchface.workflows.marker_input import DEFAULT_OPTIONS, MarkerOptions, frame_span, pose_warnings, read_markers
from torchface.workflows.solve.head_camera import HeadCamera, Predicted, predicted_curves
from torchface.workflows.solve.solution import Solution, SolveReport
from torchface.workflows.solve.take_check import check_coverage, check_explained, fit_warnings
from torchface.workflows.solve.weight_stream import StreamReport, stream_markers, stream_weights
from torchface.workflows.weight_files import WeightFiles, check_live_link, write_weights

_SHOWN_SPANS = 6


@dataclass(frozen=True)
class SolveSettings:
    """How a take is solved.

    Args:
        neutral: a frame with the face at rest, which lays the take on the rig; whole take if absent and ``align``.
        align: lay the take on the rig; otherwise its markers are in the rig's space already, unless ``neutral`` says.
        subtract_rest: subtract what is left at rest between markers and sites, where the take is laid on the rig.
        slip: the helmet moves on the head.
        clean: find and repair swapped labels, spikes and markers that drift or fell off.
        frame_by_frame: every frame on its own; otherwise the weights of the whole take at once, smooth over time. With
            what a head camera saw every frame is on its own.
        sparsity, ridge: see ``MarkerSolver``.
        insist: solve what the rig does not explain, too.
    """

    neutral: int | None = None
    align: bool = False
    subtract_rest: bool = True
    slip: bool = False
    clean: bool = False
    frame_by_frame: bool = False
    sparsity: float = SPARSITY
    ridge: float = RIDGE
    insist: bool = False


def solve_markers(
    rig: BlendshapeRig,
    attachment: Attachment,
    take: Take,
    settings: SolveSettings = SolveSettings(),
    predicted: Predicted | None = None,
    progress: Progress | None = None,
) -> Solution:
    """A take's weights: laid on the rig, cleaned, freed of slip and of what is left at rest, solved.

    Args:
        rig: the performer's.
        attachment: where the markers sit; markers match by label.
        take: markers, in any space.
        settings: which of these steps.
        predicted: what a head camera saw, for the hybrid solve.
        progress: called with each step and how far it is.

    Raises:
        AlignmentError: the rig does not explain the markers, unless the settings insist.
        TorchfaceError: take and attachment do not fit each other, or the settings do not fit the take.
    """
    progress = progress or silent
    whole = predicted is None and not settings.frame_by_frame
    coverage = check_coverage(attachment, take, len(rig.names), settings.insist)
    empty = empty_frames(take)
    alignment = None
    if settings.align or settings.neutral is not None:
        progress("laying the take on the rig")
        alignment = align_take(rig, attachment, take, settings.neutral, settings.insist)
    terms = {"sparsity": settings.sparsity, "ridge": settings.ridge}
    solver = MarkerSolver(rig, attachment, alignment, **terms)
    fit = check_explained(solver, take, settings.slip, settings.insist)
    warnings = [*coverage.warnings(), *fit_warnings(fit, alignment is not None)]
    warnings += [] if alignment is None else pose_warnings(alignment)
    if len(empty):
        numbers = take.extras.get("frame_numbers", torch.arange(len(take)))[empty]
        warnings.append(f"{_frames_text(numbers)} show no marker; their weights come from the frames before and after")
    cleanup = None
    if settings.clean:
        progress("looking for what is wrong with the take")
        cleanup = clean_take(solver, take, settings.slip)
        take = cleanup.take if whole else cleanup.filled
    progress("solving")
    motion = None
    steady, space = take, alignment
    assert take.markers is not None
    if settings.slip:
        steady, motion = _without_slip(rig, attachment, alignment, settings, take)
        space = None
    if settings.subtract_rest and alignment is not None:
        attachment = rest_residual(rig, attachment, steady, space)
        if settings.slip:
            steady, motion = _without_slip(rig, attachment, alignment, settings, take)
    solver = MarkerSolver(rig, attachment, space, **terms)
    if predicted is not None:
        solved = HybridSolver(solver).solve_take(steady, predicted.weights, predicted.gamma)
    else:
        solved = WholeTakeSolver(solver).solve_take(steady) if whole else solver.solve_take(steady)
    labels = tuple(label for label in attachment.labels or () if label in take.markers.names)
    assert steady.markers is not None
    markers = steady.markers.select(labels).values
    if space is not None:
        markers = space.apply(markers)
    if cleanup is not None and cleanup.take.markers is not None:  # what was filled in was not seen
        markers = torch.where(torch.isnan(cleanup.take.markers.select(labels).values), torch.nan, markers)
    return Solution(
        replace(take, weights=solved.weights),
        markers,
        attachment.select(labels),
        alignment,
        motion,
        cleanup,
        tuple(warnings),
    )


def _frames_text(rows: Tensor) -> str:
    """How many frames and which: ``10 frames (120–128, 340)``."""
    breaks = (rows.diff() > 1).nonzero()[:, 0].tolist()
    firsts, lasts = [0, *(i + 1 for i in breaks)], [*breaks, len(rows) - 1]
    spans = [(int(rows[a]), int(rows[b])) for a, b in zip(firsts, lasts, strict=True)]
    shown = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in spans[:_SHOWN_SPANS])
    more = f" and {len(spans) - _SHOWN_SPANS} more stretches" if len(spans) > _SHOWN_SPANS else ""
    return f"{len(rows)} frames ({shown}{more})"


def _without_slip(
    rig: BlendshapeRig, attachment: Attachment, alignment: Similarity | None, settings: SolveSettings, take: Take
) -> tuple[Take, HelmetMotion]:
    """The take in rig space as a steady helmet would have seen it, and the helmet's motion."""
    _, motion = HelmetSolver(rig, attachment, alignment, settings.sparsity, settings.ridge).solve_take(take)
    assert take.markers is not None
    values = take.markers.values.double()
    if alignment is not None:
        values = alignment.apply(values)
    return replace(take, markers=Track(take.markers.names, motion.undo(values).to(take.markers.values))), motion


@dataclass(frozen=True)
class TakeInputs:
    """What is solved.

    Args:
        rig: a file or folder of the performer's rig.
        take: a file of markers.
        attachment: a file that says where the markers sit on the rig.
        part: an annotated region that the rig is cut to, such as ``"face"``.
        camera: what a head camera saw of the take.
        options: how the take's markers are read.
    """

    rig: Path
    take: Path
    attachment: Path
    part: str | None = None
    camera: HeadCamera | None = None
    options: MarkerOptions = DEFAULT_OPTIONS


@dataclass(frozen=True)
class TakeOutputs(WeightFiles):
    """What becomes of a solved take.

    Args:
        out, animation, live_link: see :class:`~torchface.workflows.weight_files.WeightFiles`.
        report: a folder for a page, if wanted.
        stream: an address that the weights are sent to in their own time, if wanted.
    """

    report: Path | None = None
    stream: str | None = None


def solve_take(
    inputs: TakeInputs,
    outputs: TakeOutputs,
    settings: SolveSettings = SolveSettings(),
    progress: Progress | None = None,
) -> SolveReport:
    """Reads, solves, writes; see ``torchface solve --help``.

    Raises:
        ValueRangeError: the take holds no markers.
        TorchfaceError: any file is broken or does not fit the others.
    """
    progress = progress or silent
    report, stream, camera = outputs.report, outputs.stream, inputs.camera
    outputs.check(report)
    if stream is not None:
        find_receiver(stream)
    progress("reading the rig")
    loaded = load_rig(inputs.rig, part=inputs.part)
    check_live_link(loaded.names, outputs.live_link)
    if stream is not None:
        check_live_link(loaded.names, stream)
    where = Attachment.load(inputs.attachment)
    where.check(loaded.neutral, inputs.attachment, inputs.rig)
    progress("reading the take")
    played, notes = read_markers(inputs.take, where.labels or (), inputs.options)
    span = frame_span(inputs.options.frames, len(played))
    if settings.neutral is not None:
        settings = replace(settings, neutral=_within(settings.neutral, span))
    predicted = None if camera is None else predicted_curves(camera, played, loaded.names, progress).frames(span)
    played = played.frames(span)
    started = time.perf_counter()
    solution = solve_markers(loaded, where, played, settings, predicted, progress)
    seconds = time.perf_counter() - started
    solved = solution.take
    assert solved.weights is not None
    progress("writing")
    written = write_weights(solved, outputs.out, outputs.live_link)
    if outputs.animation is not None:
        make_folder(outputs.animation.parent)
        save_animation(loaded, solved, outputs.animation)
    sites = solution.attachment
    offset = torch.zeros(len(sites.triangles), 3) if sites.residual is None else sites.residual
    rmse = marker_rmse(loaded, sites, solved.weights.values[..., 0], solution.markers - offset.to(solution.markers))
    done = SolveReport(
        solved,
        rmse,
        float(torch.isfinite(solution.markers).all(-1).sum()) / (len(solved) * len(where.triangles)),
        solution.alignment,
        seconds,
        solution.motion,
        solution.cleanup,
        predicted,
        warnings=(*notes, *solution.warnings, *written),
        rig=loaded,
    )
    if report is not None:
        from torchface.workflows.solve.solve_page import write_solve_page  # matplotlib takes its time

        progress("writing the report")
        write_solve_page(report, inputs.take.name, done, loaded, solution)
    if stream is not None:
        progress(f"sending to {stream}")
        done = replace(done, sent=_sent(loaded, solution, settings, stream, predicted is not None))
    return done


def _within(frame: int, span: slice) -> int:
    """A frame of the file as a row of what is left of it."""
    if not span.start <= frame < span.stop:
        raise ValueRangeError(
            f"--neutral: found frame {frame}, expected one of those that are solved, {span.start} to {span.stop - 1}"
        )
    return frame - span.start


def _sent(
    rig: BlendshapeRig, solution: Solution, settings: SolveSettings, address: str, predicted: bool
) -> StreamReport:
    """Frames in their own time, solved one by one as they are due and smoothed by those before; those of a take with a
    video, which need more than their own markers, as they were solved."""
    take = solution.take
    assert take.weights is not None
    if predicted:
        return stream_weights(take.weights.values[..., 0], take.weights.names, take.fps, address)
    solver = LiveMarkerSolver(MarkerSolver(rig, solution.attachment, None, settings.sparsity, settings.ridge))
    smoothing = None if settings.frame_by_frame else OneEuroFilter(take.fps)
    return stream_markers(solver, solution.markers.float(), take.fps, address, smoothing=smoothing)

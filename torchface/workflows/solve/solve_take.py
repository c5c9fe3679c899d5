"""From a rig, a marker take and an attachment on disk to weights on disk."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from torchface.attachment import Attachment
from torchface.io import load_rig
from torchface.io.protocols.weight_sender import find_receiver
from torchface.progress import Progress, silent
from torchface.workflows.marker_input import DEFAULT_OPTIONS, MarkerOptions, frame_span, read_markers, row_of
from torchface.workflows.solve.head_camera import HeadCamera, predicted_curves
from torchface.workflows.solve.solution import SolveReport, SolveSettings, solve_markers
from torchface.workflows.solve.weight_stream import stream_take
from torchface.workflows.weight_files import WeightFiles, check_live_link, with_eyes, write_weights


@dataclass(frozen=True)
class TakeInputs:
    """What is solved."""

    rig: Path  # a file or folder of the performer's rig
    take: Path
    attachment: Path  # a file that says where the markers sit on the rig
    part: str | None = None  # an annotated region that the rig is cut to, such as "face"
    camera: HeadCamera | None = None  # what a head camera saw of the take
    options: MarkerOptions = DEFAULT_OPTIONS  # how the take's markers are read


@dataclass(frozen=True)
class TakeOutputs(WeightFiles):
    """What becomes of a solved take."""

    report: Path | None = None  # a folder for a page
    stream: str | None = None  # an address that the solved weights are sent to in their own time


def solve_take(
    inputs: TakeInputs, outputs: TakeOutputs, settings: SolveSettings, progress: Progress | None = None
) -> SolveReport:
    """Reads, solves, writes; see ``torchface solve --help``."""
    progress = progress or silent
    outputs.check(outputs.report)
    if outputs.stream is not None:
        find_receiver(outputs.stream)

    progress("reading the rig")
    rig = load_rig(inputs.rig, part=inputs.part)
    check_live_link(rig.names, outputs.live_link)
    if outputs.stream is not None:
        check_live_link(rig.names, outputs.stream)
    attachment = Attachment.load(inputs.attachment)
    attachment.check(rig.neutral, inputs.attachment, inputs.rig)
    progress("reading the take")
    take, notes = read_markers(inputs.take, attachment.labels or (), inputs.options)
    span = frame_span(inputs.options.frames, take)
    if settings.neutral is not None:
        settings = replace(settings, neutral=row_of(settings.neutral, take.numbers[span]))
    settings = replace(settings, free_scale=inputs.options.frees_scale(inputs.take))
    camera, predicted = inputs.camera, None
    if camera is not None:
        predicted = predicted_curves(camera, take, rig.names, progress).frames(span)

    started = time.perf_counter()
    solution = solve_markers(rig, attachment, take.frames(span), settings, predicted, progress)
    seconds = time.perf_counter() - started

    progress("writing")
    left_out, written = write_weights(solution.take, outputs, rig, inputs.rig if inputs.part is None else None)
    samples = len(solution.take) * len(attachment.triangles)
    seen = float(torch.isfinite(solution.markers).all(-1).sum()) / samples
    warnings = (*notes, *solution.warnings, *left_out)
    report = SolveReport(solution, seen, seconds, predicted, warnings=warnings, notes=tuple(written))
    if outputs.report is not None:
        from torchface.workflows.solve.solve_page import write_solve_page  # matplotlib takes its time

        progress("writing the report")
        write_solve_page(outputs.report, inputs.take.name, report)
    if outputs.stream is not None:
        progress(f"sending to {outputs.stream}")
        sent = stream_take(with_eyes(solution.take, rig), outputs.stream)
        report = replace(report, notes=(*report.notes, sent))
    return report

"""Examples of somebody before a camera, who is asked for one expression after the other."""

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.anybody import ExampleExpression, ExampleShapes, paper_expressions, shown_examples
from torchface.io.video import open_video
from torchface.landmarks import LandmarkTracker, NoFaceError
from torchface.number_checks import checked_number
from torchface.workflows.live.live_frames import open_source, planes
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder

SECONDS = 4.0  # for each expression, if nothing else is asked for

_READY = 0.5  # the share of that time in which the person gets into the expression
_MORE = 10.0  # seconds more where a camera sees no face
_LEAST = 3

Say = Callable[[str], None]  # takes a sentence for the person


def guided_examples(
    camera: str, say: Say, seconds: float = SECONDS, landmarks: str = DEFAULT_LANDMARKS
) -> ExampleShapes:
    """The paper's 16 expressions of the person before a camera, or in a film of one; of each the frame in which they
    are calmest.

    ``say`` is called with what the person should do, for so many seconds each, and the count-down.
    """
    checked_number("--seconds", seconds, 0.1, 60.0)
    tracker = LandmarkTracker(load_finder(landmarks).finder)
    if re.fullmatch("[0-9]{1,3}", camera):
        source = open_source(camera, say)
        try:
            frames = ((came, tracker.step(planes(frame)).landmarks) for came, frame in source.frames())
            return _session(frames, say, seconds, camera, _MORE)
        finally:
            source.close()
    video = open_video(Path(camera))
    timed = ((number / video.fps, frame) for number, frame in enumerate(video.color_frames()))
    return _session(((came, tracker.step(frame).landmarks) for came, frame in timed), say, seconds, camera, 0.0)


def _session(
    frames: Iterator[tuple[float, Tensor]], say: Say, seconds: float, camera: str, more: float
) -> ExampleShapes:
    expressions = paper_expressions()
    faces = []
    started: float | None = None
    for number, expression in enumerate(expressions):
        say(f"{number + 1} of {len(expressions)}, {expression.name}: {expression.prompt}")
        window, started = _held(frames, started, seconds, more, say)
        if len(window) < _LEAST:
            raise NoFaceError(_lost(camera, expression, started is None, len(window)))
        faces.append(calmest(torch.stack(window)))
    say("done")
    return shown_examples([expression.name for expression in expressions], torch.stack(faces))


def _held(
    frames: Iterator[tuple[float, Tensor]], started: float | None, seconds: float, more: float, say: Say
) -> tuple[list[Tensor], float | None]:
    """Landmarks while an expression is held, and when it ended; None where the frames did."""
    window: list[Tensor] = []
    announced = math.ceil(_READY * seconds) + 1
    for came, landmarks in frames:
        started = came if started is None else started
        since = came - started
        left = math.ceil(_READY * seconds - since)
        if 0 < left < announced:
            say(f"  {left}")
            announced = left
        elif left <= 0 < announced:
            say("  hold")
            announced = 0
        if since >= _READY * seconds and bool(torch.isfinite(landmarks).all()):
            window.append(landmarks)
        if since >= seconds and (len(window) >= _LEAST or since >= seconds + more):
            # A clock that goes on from expression to expression, unless a face was waited for.
            return window, (started + seconds if since < seconds + 1 else came)
    return window, None


def calmest(landmarks: Tensor) -> Tensor:
    """The frame (68,2) of some (T,68,2) round which the face moves least."""
    steps = (landmarks[1:] - landmarks[:-1]).norm(dim=-1).mean(1)
    motion = torch.nn.functional.pad(steps, (1, 0)) + torch.nn.functional.pad(steps, (0, 1))
    # At the ends one neighbour is not known: they count as moving as much there as where they are known.
    motion[[0, -1]] *= 2
    return landmarks[int(motion.argmin())]


def _lost(camera: str, expression: ExampleExpression, ended: bool, count: int) -> str:
    why = "the frames ended" if ended else "expected a face that stays in the picture"
    return f"{camera}: found a face in {count} frames while {expression.name} was asked for; {why}"

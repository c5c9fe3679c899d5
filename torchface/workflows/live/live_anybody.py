"""Anybody before a webcam moves a character: the whole job from a camera to streams, a page and files."""

import atexit
import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from torchface.capture.anybody import WebcamControls, WebcamSettings
from torchface.capture.anybody.skin_follower import SkinFollower
from torchface.capture.anybody.webcam_state import StateLayout
from torchface.errors import TorchfaceError, ValueRangeError
from torchface.files.job_lock import job_lock
from torchface.files.whole_files import visible_files
from torchface.io import load_take
from torchface.io.protocols.stream_address import is_source, parse_source
from torchface.io.protocols.weight_sender import find_receiver
from torchface.io.take_files import RECORDING_ENDINGS
from torchface.landmarks.images.frame_reader.face_reader import STATE
from torchface.number_checks import checked_number
from torchface.onnx.webcam.webcam_session import ModuleSession, WebcamSession
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT
from torchface.workflows.browser_app.app_folder import CHARACTER, TABLE
from torchface.workflows.browser_app.built_page import built_page
from torchface.workflows.browser_app.character import load_character
from torchface.workflows.live.camera import DEFAULT_SIZE
from torchface.workflows.live.kept_takes import (
    ANIMATION,
    LIVE_LINK,
    SUMMARY,
    WEIGHTS,
    kept_takes,
    printable,
    take_file,
    take_rows,
)
from torchface.workflows.live.live_figures import LiveReport
from torchface.workflows.live.live_frames import FaceSolver, FrameSource, LiveFrame, Say, SourceSettings, open_source
from torchface.workflows.live.live_session import LiveSession, Notes
from torchface.workflows.live.page_server import PageServer, Preparing
from torchface.workflows.live.received_source import ReceivedSolver, ReceivedSource, ReceivedWatch
from torchface.workflows.live.recordings import Recordings, SavedTake
from torchface.workflows.live.session_prompts import LightWatch, Watch
from torchface.workflows.live.weight_streams import WeightStreams
from torchface.workflows.webcam.webcam_graph import kept_webcam_graph, skin_follower, webcam_module

_USUAL = 1 / 30  # seconds
# Beside a session, which goes first.
_MAKE = """
import os
from torchface.workflows.webcam.webcam_graph import prepared_webcam_graph
if hasattr(os, "nice"):
    os.nice(5)
prepared_webcam_graph()
"""


_UNMADE = "the graph was not ready by the last frame: PyTorch read all faces; the next start takes what is made of it"
_MADE = "the graph is made: it read the last faces, and reads all from the next start on"


class PersonSolver:
    """Solves frames for ARKit's weights, which then follow the skin; ``better`` gives once a session to go on with,
    else None. ``reader`` says what has become of it."""

    def __init__(
        self, session: WebcamSession, skin: SkinFollower, better: Callable[[], WebcamSession | None] | None = None
    ) -> None:
        self._session, self._skin, self._better = session, skin, better
        self._layout = StateLayout(len(skin.names), WebcamSettings().coefficients)
        self._ever, self.reader = False, "" if better is None else _UNMADE

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self._session.names

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """Solves the next frame; see :class:`torchface.workflows.live.live_frames.FaceSolver`."""
        if self._better is not None and (better := self._better()) is not None:
            better.resume(self._session.state)
            self._session, self.reader = better, _MADE
        self._session.controls = controls
        interval = _USUAL if interval is None else interval
        answer = self._session.step(picture, interval)
        state = self._layout.unpack(self._session.state[STATE:])
        solved = LiveFrame(
            self._skin.followed(picture, state, interval, controls),
            answer.rotation,
            answer.landmarks,
            answer.iris,
            answer.gaze,
            answer.calibrated,
            beside=answer.beside,
        )
        self._ever = (self._ever and not controls.reset) or solved.seen
        # Before the first face the graph's head looks anywhere.
        return solved if self._ever else replace(solved, rotation=torch.full((3, 3), torch.nan))


def person_solver(progress: Progress) -> PersonSolver:
    """A solver for whoever sits before a camera.

    Its graph takes a minute to be made, once. Until then PyTorch solves, with the same weights at a lower rate.
    """
    skin = skin_follower()
    if (graph := kept_webcam_graph()) is not None:
        return PersonSolver(WebcamSession(graph), skin)
    progress("reading faces by PyTorch until the quicker graph is there, once")
    return PersonSolver(ModuleSession(webcam_module()), skin, _SessionBeingMade().take)


class _SessionBeingMade:
    """A session whose graph is made in a process of its own, which ends with this one."""

    def __init__(self) -> None:
        self._made: queue.Queue[WebcamSession] = queue.Queue()
        threading.Thread(target=self._make, name="torchface-graph", daemon=True).start()

    def take(self) -> WebcamSession | None:
        """The session, once."""
        with suppress(queue.Empty):
            return self._made.get_nowait()
        return None

    def _make(self) -> None:
        nothing = subprocess.DEVNULL
        making = subprocess.Popen([sys.executable, "-P", "-c", _MAKE], stdin=nothing, stdout=nothing, stderr=nothing)
        atexit.register(making.kill)
        making.wait()
        if (graph := kept_webcam_graph()) is not None:  # else PyTorch goes on
            self._made.put(WebcamSession(graph))


RECORDINGS = Path("recordings")
"""Where the page's button records to, where no folder was named."""


@dataclass(frozen=True)
class LiveSettings:
    """What a live session is made of."""

    # a device's number; a video file, which is played at its own rate, every frame of it where `record` names a folder;
    # or an address at which faces are received, such as `livelink://:11111`
    camera: str = "0"
    character: Path | None = None  # a rig by ARKit's names; the embedded performer if absent
    mapping: Path | None = None  # a table for shapes of other names
    addresses: tuple[str, ...] = ()  # see `open_sender`
    record: Path | None = None  # a folder to record into from the first frame on
    takes: Path | None = None  # a folder of takes for the page, which also takes the recordings that lie there
    calibrate: bool = False  # begin with the guided calibration
    page: bool = True  # open the page in the browser
    port: int = 8080  # the first that the page tries
    loop: bool = False  # play a video file again and again
    seconds: float | None = None  # after which it ends
    # an actor's model by name or folder, with which takes are enhanced when the session ends
    enhance: str | None = None
    size: tuple[int, int] = DEFAULT_SIZE  # width and height to ask a camera for


def go_live(
    settings: LiveSettings,
    say: Say,
    opened: Say,
    make_solver: Callable[[Progress], FaceSolver],
    progress: Progress | None = None,
) -> tuple[LiveReport, list[SavedTake]]:
    """Solves, sends, records and shows what a camera sees, until it ends or is interrupted: the figures, and what was
    recorded.

    ``say`` is called with what the user should know, ``opened`` with the page's address.
    """
    progress = progress or silent
    for address in settings.addresses:
        find_receiver(address)
    if is_source(settings.camera):
        parse_source(settings.camera)
    if settings.seconds is not None:
        checked_number("seconds", settings.seconds, above=True)
    if settings.enhance is not None:
        from torchface.workflows.enhance.enhance_animation import load_model  # a tenth of all that is imported

        load_model(settings.enhance)  # which is wrong should not be said after the take
    notes = Notes(say)
    with ExitStack() as stack:
        if settings.record is not None:
            stack.enter_context(job_lock(settings.record))
        every = settings.record is not None  # a film that is recorded loses no frame
        source: FrameSource
        received = None
        if is_source(settings.camera):
            source = received = ReceivedSource(settings.camera, every)
        else:  # what is missing should be said before models are read
            progress("opening the camera" if settings.camera.isdigit() else "opening the film")
            source = open_source(settings.camera, notes, SourceSettings(settings.size, every, settings.loop))
        stack.enter_context(closing(source))
        with ThreadPoolExecutor(1) as beside:
            building = beside.submit(built_page, progress) if settings.page else None  # by other programs
            progress("reading the character")
            character = load_character(settings.character, settings.mapping, progress)
            for note in character.notes():
                notes(note)
            page = None if building is None else building.result()
        folder = settings.record or settings.takes or RECORDINGS
        recordings = Recordings(folder, character, source.video.path.name, source.video.fps)
        preparing, server = Preparing(progress), None
        if page is not None:  # before the solver, which may take a minute the first time
            files = {CHARACTER: character.data, TABLE: character.page_table()}
            server = PageServer(page, files, partial(take_file, recordings.folder), preparing, settings.port)
            stack.callback(_keep_dropped, preparing, recordings, notes)
            stack.callback(server.stop)
            opened(server.url)
            say(f"For OBS, the character alone: {server.stream_url}")
        solver: FaceSolver
        watch: Watch
        if received is not None:
            received.skip()
            solver, watch = ReceivedSolver(received, notes), ReceivedWatch(received, say)
        else:
            preparing("loading the face reader")
            solver = make_solver(preparing)
            watch = LightWatch()
        streams = stack.enter_context(WeightStreams(settings.addresses, ARKIT, source.video.fps, notes))
        if settings.takes is not None:
            import_recordings(settings.takes, recordings, notes)
        session = LiveSession(source, solver, streams, recordings, notes, say, watch)
        if settings.record is not None:
            place = recordings.start()
            if place != settings.record:
                notes(f"{settings.record} holds a take, which is kept: this one is recorded into {place}")
        session.guided = settings.calibrate
        if settings.calibrate and page is None:
            session.calibrate()
        try:
            if server is not None:
                server.attend(session)
                stack.callback(server.stop)  # before the streams end
            session.run(settings.seconds, progress)
        finally:
            session.close()
            if recordings.running:
                progress("writing the recording")
            saved = recordings.finish()
        if settings.enhance is not None:
            _enhance(saved, settings.enhance, notes, progress)
        if session.figures.frames == 0:
            raise ValueRangeError(f"{settings.camera}: found no frame, expected at least one")
        wrong = received.receiver.counts.words() if received is not None else ""
        more = (wrong, *(take.note for take in saved), *streams.notes())
        silence = "" if received is None else received.silence
        said = tuple(note for note in more if note)
        reader = solver.reader if isinstance(solver, PersonSolver) else ""
        return LiveReport(session.figures, source.dropped, said, silence, bool(settings.addresses), reader), saved


def _keep_dropped(preparing: Preparing, recordings: Recordings, say: Say) -> None:
    """Keeps the takes that a page gave to a session that never began."""
    if preparing.takes:
        preparing.hand_over(lambda name, rows: recordings.keep(name, torch.from_numpy(rows.copy())))
        say(f"what was dropped on the page is kept in {recordings.folder}")


def import_recordings(folder: Path, recordings: Recordings, say: Say) -> None:
    """Makes takes of the recordings that lie in a folder as files, such as a phone's, once each."""
    known = {take.name for take in kept_takes(folder)}
    for path in visible_files(folder, (".csv", *RECORDING_ENDINGS)) if folder.is_dir() else []:
        if printable(path.name) not in (WEIGHTS, LIVE_LINK, SUMMARY, *known):
            try:
                recordings.keep(path.name, take_rows(load_take(path)).float())
            except TorchfaceError as error:
                say(f"{path}: left out: {error}")


ENHANCED = "enhanced"
"""The folder in a take's with what enhancement writes."""


def _enhance(takes: list[SavedTake], model: str, say: Say, progress: Progress) -> None:
    """Writes each take with an actor's wrinkles beside its files."""
    from torchface.workflows.enhance.enhance_animation import EnhanceSettings, enhance_animation

    for take in takes:
        if take.error or not take.frames:
            continue
        out = take.folder / ENHANCED
        try:
            with job_lock(out):
                done = enhance_animation(take.folder / ANIMATION, model, out, EnhanceSettings(video=False), progress)
            for line in (*done.lines(), str(done.products["animation"])):
                say(line)
        except TorchfaceError as error:
            say(f"{take.folder}: not enhanced: {error}")

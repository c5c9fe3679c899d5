"""A phone or another program as a camera: the faces that it sends, and what is made of each."""

import math
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.capture.anybody import WebcamControls
from torchface.capture.curve_calibration import CurveCalibration
from torchface.io.protocols.received_face import ReceivedFace
from torchface.io.protocols.weight_receiver import WeightReceiver, packet_kind
from torchface.io.video import VideoFile
from torchface.shape_names import ARKIT
from torchface.temporal.one_euro import OneEuroSettings, one_euro_step
from torchface.workflows.head_rotations import head_rotations
from torchface.workflows.live.live_frames import LiveFrame, Say
from torchface.workflows.live.session_prompts import STEPS

_FPS = 60.0  # of phones, where times do not say
_SIZE = (480, 360)
_SILENT, _TICK, _WAIT = 0.1, 1 / 30, 0.2  # seconds without a packet: until the first tick, between ticks, at rest
_HOLD, _RELAX, _RESTS = 0.5, 0.4, 4.0  # seconds: the last face is held, falls to 1/e, is at rest
_LOOKS = 100  # at what has waited
_PATIENCE = 5.0  # seconds without a face until it is said what may be wrong
_NO_ROUTE = "192.0.2.1"  # an address for documentation: nothing is sent to it
_CUTOFF, _SPREAD, _SPEED = 9.0, 9.0, 10.0  # Hz without smoothing, by how much less with all, and for each unit a second


class ReceivedSource:
    """Faces (``WeightReceiver``) as a source of frames, each or the newest of those that wait; while none come,
    ticks go on so that the last one can relax."""

    def __init__(self, address: str, every: bool = False) -> None:
        self.receiver = WeightReceiver(address)
        self.video = VideoFile(Path(f"{self.receiver.scheme} {self.receiver.port}"), _FPS, *_SIZE, 1)
        self.dropped, self.late, self._every = 0, 0.0, every
        self._in_parts = self.receiver.scheme == "osc"  # where each weight may come in a packet of its own
        self.face: ReceivedFace | None = None
        self.fresh, self.heard = False, float("-inf")
        self._waited = False  # whether ``face`` came before the first frame
        self._picture = np.empty((0, 0, 3), np.uint8)

    def frames(self) -> Iterator[tuple[float, np.ndarray]]:
        """When each face came, and a picture without pixels; ``face`` is the face."""
        wait = _WAIT
        while True:
            faces = self.receiver.faces(wait)
            if len(faces) > 1 and (not self._every or self._in_parts):
                self.dropped += 0 if self._in_parts else len(faces) - 1
                faces = faces[-1:]
            for came, face in faces:
                self.face, self.fresh, self.heard, self._waited = face, True, came, False
                yield came, self._picture
                wait = _SILENT
            if not faces:
                now = time.perf_counter()
                self.fresh, self._waited = self._waited, False
                wait = _TICK if now - self.heard < _RESTS else _WAIT
                yield now, self._picture

    def skip(self) -> None:
        """Leaves out what came since the address was opened: it has waited and would come as one.

        The last face is the first frame where none comes soon: some programs send only what changes.
        """
        for _ in range(_LOOKS):
            if not (faces := self.receiver.faces(0.0)):
                break
            (self.heard, self.face), self._waited = faces[-1], True

    @property
    def place(self) -> str:
        """Where it listens and what to type into the app, in words."""
        receiver = self.receiver
        at = f"port {receiver.port} (UDP)" + (f" of {receiver.host}" if receiver.host else "")
        if receiver.asks:
            return f"{at}: {receiver.address} is asked to send; open iFacialMocap there"
        if receiver.host and ip_address(receiver.host).is_loopback:
            return (
                f"{at}, which only this machine reaches; for a phone, start with {receiver.scheme}://:{receiver.port}"
            )
        return f"{at}: have the app send to {receiver.host or own_address()}"

    @property
    def silence(self) -> str:
        """What to say where no face has come; empty where one has."""
        receiver, counts = self.receiver, self.receiver.counts
        if self.face is not None:
            return ""
        if counts.packets:
            kind, scheme = packet_kind(counts.first)
            other = f"; {scheme}://:{receiver.port} receives those" if scheme not in ("", receiver.scheme) else ""
            return f"no face has come, but packets ({counts.packets}) that look like {kind}{other}"
        others = [] if receiver.host or receiver.asks else other_addresses()
        more = f" (or to {', '.join(others)}, whichever is in its network)" if others else ""
        return f"no packet has come to {self.place}{more}. A firewall on this machine may hold packets back"

    def close(self) -> None:
        """Gives the port back."""
        self.receiver.close()


class ReceivedSolver:
    """What a received face is for the session: corrected for the person, smoothed, held and relaxed while it is
    lost."""

    names = ARKIT

    def __init__(self, source: ReceivedSource, say: Say) -> None:
        self._source, self._say = source, say
        self._calibration = CurveCalibration()
        self._state: tuple[Tensor, Tensor] | None = None
        self._pose = 0
        self._lost = 0.0

    def step(self, picture: np.ndarray, interval: float | None, controls: WebcamControls) -> LiveFrame:
        """The next frame; see :class:`torchface.workflows.live.live_frames.FaceSolver`."""
        face, between = self._source.face, interval or 1 / _FPS
        if controls.reset:
            self._calibration, self._pose = CurveCalibration(), 0
        if self._source.fresh and face is not None and face.found:
            self._lost = 0.0
            if not controls.freeze:
                self._calibration.add(face.weights, controls.pose, between)
            corrected = self._calibration.correction(face.weights)
            values = self._smoothed(torch.cat([corrected, face.rotations]), between, controls.smoothing)
        else:
            self._lost += between
            values = torch.zeros(len(ARKIT) + 9) if self._state is None else self._state[0]
            if self._lost > _HOLD:
                values = values * math.exp(-between / _RELAX)
                self._state = values, torch.zeros_like(values)
        if self._pose == len(STEPS) and controls.pose == 0:
            for missed in self._calibration.missed:
                self._say(f"calibration: not held: {STEPS[missed - 1]}; its shapes keep their gain")
        self._pose = controls.pose
        weights, rotations = (controls.gain * values[: len(ARKIT)]).clamp(0, 1), values[len(ARKIT) :]
        ever = self._state is not None
        return LiveFrame(
            weights,
            head_rotations(rotations[:3]) if ever else torch.full((3, 3), torch.nan),
            torch.full((68, 2), torch.nan),
            # To the person's left and up, the right eye first; yaw is to the right, pitch down.
            gaze=-torch.stack([rotations[6:8], rotations[3:5]]),
            calibrated=self._calibration.learned,
            found=ever and self._lost <= _HOLD,
            fresh=self._source.fresh,
            sent=math.nan if face is None else face.sent,
        )

    def _smoothed(self, values: Tensor, interval: float, smoothing: float) -> Tensor:
        if self._state is None or smoothing == 0:
            self._state = values, torch.zeros_like(values)
            return values
        settings = OneEuroSettings(_CUTOFF * _SPREAD**-smoothing, _SPEED, _CUTOFF)
        self._state = one_euro_step(values, *self._state, interval, settings)
        return self._state[0]


class ReceivedWatch:
    """Words about the sender, for the status line; each change is said."""

    def __init__(self, source: ReceivedSource, say: Say) -> None:
        self._source, self._say = source, say
        self._state = ""
        self._began: float | None = None
        self._waiting, self._silence = f"Waiting for a face at {source.place}", ""
        self.words = self._waiting
        say(self.words)

    def look(self, picture: np.ndarray, solved: LiveFrame, now: float) -> None:
        """Updates ``words`` after a frame."""
        source, counts = self._source, self._source.receiver.counts
        if source.face is None:
            self._began = now if self._began is None else self._began
            late = now - self._began >= _PATIENCE
            if late and (counts.packets or not self._silence):  # to look addresses up may take a second
                self._silence = f"For {_PATIENCE:g} seconds {source.silence}"
            words = self._silence if late else self._waiting
            state = counts.fault + (f" after {_PATIENCE:g} s {packet_kind(counts.first)[1]}" if late else "")
        elif source.fresh and not source.face.found:
            state = words = f"{source.receiver.sender}: connected, but sees no face: the last expression is held"
        elif source.fresh or now - source.heard < _HOLD:
            state = words = f"Receiving from {source.receiver.sender}"
        else:
            state = f"Nothing from {source.receiver.sender}: the last expression is held, then relaxes"
            words = f"{state} ({now - source.heard:.0f} s)"
        wrong = counts.words()
        self.words = f"{words} · {wrong}" if wrong else words
        state += " and more" if counts.unused else ""  # addresses that move nothing are named once
        if state != self._state:
            self._state = state
            self._say(self.words)


def own_address() -> str:
    """This machine's address in its network; its name where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((_NO_ROUTE, 9))
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def other_addresses() -> list[str]:
    """What else this machine's name stands for, such as its address in a second network."""
    with suppress(OSError):
        found = {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
        return sorted(one for one in found - {own_address()} if not ip_address(one).is_loopback)
    return []

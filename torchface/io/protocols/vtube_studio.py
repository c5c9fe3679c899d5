"""VTube Studio's plug-in API: parameters of a Live2D model set over a WebSocket, after the user allowed it once."""

import json
import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from torch import Tensor

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.cache_folder import cache_folder
from torchface.files.whole_files import write_file
from torchface.io.protocols.live_link_packets import ArkitWeights, rotations_sent
from torchface.shape_names import ARKIT

VTUBE_STUDIO_PORT = 8001

_PLUGIN = {"pluginName": "torchface", "pluginDeveloper": "torchface"}
_CLOSED = "nobody answers: open VTube Studio and start its API in the settings"
_DENIED = 50  # the error of a user who said no
_WAIT, _ASK, _RETRY, _TICK = 3.0, 120.0, 2.0, 0.5  # seconds: an answer, the user's answer, the next try, a look round
_LARGEST, _LONGEST_TOKEN = 2**20, 64
_BOTH = ("Left", "Right")


def _means() -> dict[str, dict[str, float]]:
    """VTube Studio's own parameters as sums of ARKit's weights; ``1`` is a constant."""
    own: dict[str, dict[str, float]] = {
        "MouthOpen": {"jawOpen": 1.5, "mouthClose": -1.0},
        "MouthSmile": {"1": 0.5} | {f"mouthSmile{s}": 0.25 for s in _BOTH} | {f"mouthFrown{s}": -0.25 for s in _BOTH},
        "MouthX": {"mouthLeft": -1.0, "mouthRight": 1.0},
        "TongueOut": {"tongueOut": 1.0},
        "CheekPuff": {"cheekPuff": 1.0},
        "FaceAngry": {f"browDown{s}": 0.35 for s in _BOTH} | {f"noseSneer{s}": 0.15 for s in _BOTH},
        "Brows": {"1": 0.5, "browInnerUp": 0.25}
        | {f"browOuterUp{s}": 0.125 for s in _BOTH}
        | {f"browDown{s}": -0.25 for s in _BOTH},
    }
    for side in _BOTH:
        brow = {"1": 0.5, "browInnerUp": 0.25, f"browOuterUp{side}": 0.25, f"browDown{side}": -0.5}
        own[f"Brow{side}Y"] = brow
        own[f"EyeOpen{side}"] = {"1": 0.75, f"eyeBlink{side}": -0.75, f"eyeWide{side}": 0.25}
    return own


OWN_PARAMETERS: Mapping[str, Mapping[str, float]] = _means()
"""How the parameters that every model has follow from ARKit's weights: our choice, within VTube Studio's ranges."""

_FULL_GAZE = math.radians(30.0)


def parameters(arkit: Tensor, rotations: Tensor) -> dict[str, float]:
    """Values of VTube Studio's own parameters, of ARKit's weights (52,) and rotations (9,), radians.

    Angles of the face are degrees: X to the person's left, Y up, Z as they lean; gaze is from -1 to 1.
    """
    weights = dict(zip(ARKIT, arkit.clamp(0, 1).tolist(), strict=True)) | {"1": 1.0}
    values = {
        name: min(1.0, max(-1.0, sum(share * weights[term] for term, share in terms.items())))
        for name, terms in OWN_PARAMETERS.items()
    }
    yaw, pitch, roll, left_yaw, left_pitch, _, right_yaw, right_pitch, _ = rotations.tolist()
    values |= {
        name: math.degrees(angle)
        for name, angle in zip(("FaceAngleX", "FaceAngleY", "FaceAngleZ"), (yaw, -pitch, roll), strict=True)
    }
    gaze = {"EyeLeftX": left_yaw, "EyeLeftY": -left_pitch, "EyeRightX": right_yaw, "EyeRightY": -right_pitch}
    return values | {name: min(1.0, max(-1.0, angle / _FULL_GAZE)) for name, angle in gaze.items()}


class VTubeStudioSender:
    """Sends frames in a thread of its own: the newest one as soon as the one before has been answered.

    The first time the user is asked in VTube Studio; the token that it then gives is kept. A connection that ends is
    opened again. Beside the parameters that every model has, 50 by ARKit's names with a capital are made.

    Args:
        token: the file of the token; in the user's cache if absent.
        rate: frames a second at most; VTube Studio's own if absent.
    """

    def __init__(
        self, address: str, host: str, port: int, names: Sequence[str], token: Path | None = None, rate: float = 60.0
    ) -> None:
        self.address, self._arkit = address, ArkitWeights(names)
        self._url = f"ws://{f'[{host}]' if ':' in host else host}:{port}"
        self._token = token or cache_folder("vtube_studio") / "token.txt"
        self._interval = 1 / rate
        self._newest: tuple[Tensor, Tensor] | None = None
        self._change = threading.Condition()
        self._open, self._allowed = True, False
        self.problem = "not connected yet"
        self._made: tuple[str, ...] = ()
        self._thread = threading.Thread(target=self._run, name="torchface-vtube-studio", daemon=True)
        self._thread.start()

    def send(self, weights: Tensor, rotations: Tensor | None = None) -> bool:
        """Gives the thread a frame, weights (N,), rotations (9,), in place of one that waits; whether any is taken."""
        frame = self._arkit(weights), rotations_sent(rotations)
        with self._change:
            self._newest = frame
            self._change.notify()
        return self._allowed

    def close(self) -> None:
        """Ends the thread and the connection."""
        with self._change:
            self._open = False
            self._change.notify()
        self._thread.join(_WAIT)

    def _run(self) -> None:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        while self._open:
            try:
                with connect(
                    self._url, open_timeout=_WAIT, close_timeout=1, max_size=_LARGEST, compression=None, proxy=None
                ) as socket:
                    calls = _Calls(socket.send, lambda seconds: socket.recv(seconds))
                    self._authenticate(calls)
                    self._made = tuple(name for name in _CUSTOM if self._make(calls, name))
                    self._allowed, self.problem = True, ""
                    self._stream(calls)
            except _RefusedError as error:
                self.problem = str(error)
                if error.final:
                    break
            except (OSError, WebSocketException, ValueError, FileFormatError) as error:
                refused = isinstance(error, ConnectionRefusedError)
                self.problem = f"not connected ({_CLOSED if refused else error})"
            finally:
                self._allowed = False
            with self._change:
                if self._open:
                    self._change.wait_for(lambda: not self._open, _RETRY)

    def _authenticate(self, calls: "_Calls") -> None:
        token = ""
        with suppress(OSError, UnicodeDecodeError):
            token = self._token.read_text("ascii")[:_LONGEST_TOKEN].strip()
        for attempt in range(2):
            if not token:
                self.problem = "waits until you allow torchface in VTube Studio"
                answer = calls("AuthenticationTokenRequest", _PLUGIN, _ASK, lambda: self._open)
                token = str(answer.get("authenticationToken", ""))
                if not 0 < len(token) <= _LONGEST_TOKEN or not token.isascii():
                    raise _RefusedError(f"found a token of {len(token)} letters, expected 1 to {_LONGEST_TOKEN}")
                write_file(self._token, token.encode())
                os.chmod(self._token, 0o600)  # whoever has it moves the model
            answer = calls("AuthenticationRequest", _PLUGIN | {"authenticationToken": token})
            if answer.get("authenticated") is True:
                return
            token = ""  # revoked, or of another machine: the user is asked again, once
            if attempt:
                raise _RefusedError(f"VTube Studio refused its own token ({answer.get('reason')!s:.80})", final=True)

    def _make(self, calls: "_Calls", name: str) -> bool:
        """Makes a parameter; one that VTube Studio or another plug-in has already is left to them."""
        data = {"parameterName": name, "explanation": "torchface", "min": 0, "max": 1, "defaultValue": 0}
        try:
            calls("ParameterCreationRequest", data)
        except _RefusedError:
            return False
        return True

    def _stream(self, calls: "_Calls") -> None:
        made = [(name, ARKIT.index(name[0].lower() + name[1:])) for name in self._made]
        while True:
            begun = time.monotonic()
            with self._change:
                self._change.wait_for(lambda: self._newest is not None or not self._open, _TICK)
                if not self._open:
                    return
                frame, self._newest = self._newest, None
            if frame is None:
                continue
            values = parameters(*frame)
            own = frame[0].clamp(0, 1).tolist()
            values |= {name: own[row] for name, row in made}
            listed = [{"id": name, "value": value} for name, value in values.items()]
            calls("InjectParameterDataRequest", {"faceFound": True, "mode": "set", "parameterValues": listed})
            time.sleep(max(0.0, self._interval - (time.monotonic() - begun)))


_CUSTOM = tuple(name[0].upper() + name[1:] for name in ARKIT)


class _RefusedError(Exception):
    """VTube Studio answered that it will not; ``final`` where another try would ask the user again."""

    def __init__(self, words: str, final: bool = False) -> None:
        super().__init__(words)
        self.final = final


class _Calls:
    """Requests and their answers, one at a time."""

    def __init__(self, send: Callable[[str], None], receive: Callable[[float], str | bytes]) -> None:
        self._send, self._receive, self._count = send, receive, 0

    def __call__(
        self, kind: str, data: Mapping[str, Any], seconds: float = _WAIT, goes_on: Callable[[], bool] = lambda: True
    ) -> dict[str, Any]:
        """The data of the answer."""
        self._count += 1
        number, end = f"torchface-{self._count}", time.monotonic() + seconds
        request = {"apiName": "VTubeStudioPublicAPI", "apiVersion": "1.0", "requestID": number, "messageType": kind}
        self._send(json.dumps(request | {"data": dict(data)}))
        while goes_on():
            try:
                answer = json.loads(self._receive(min(_TICK, max(0.01, end - time.monotonic()))))
            except TimeoutError:
                if time.monotonic() > end:
                    raise ValueError(f"no answer to {kind} within {seconds:.0f} seconds") from None
                continue
            except RecursionError as error:
                raise ValueError("an answer nested too deep") from error
            if not isinstance(answer, dict) or not isinstance(answer.get("data", {}), dict):
                raise ValueError("an answer that is no table")
            if answer.get("requestID") != number:  # an event, or an answer that came too late
                continue
            found = answer.get("data", {})
            if answer.get("messageType") == "APIError":
                words = (
                    f"VTube Studio refused {kind}: {found.get('message')!s:.200} (error {found.get('errorID')!s:.20})"
                )
                raise _RefusedError(words, final=found.get("errorID") == _DENIED)
            return found
        raise ValueError("closed")


def checked_token_file(path: str, address: str) -> Path:
    """The file of a token."""
    file = Path(path).expanduser()
    if not file.parent.is_dir():
        raise ValueRangeError(f"stream: found {address!r:.200}, whose token's folder {file.parent} does not exist")
    return file

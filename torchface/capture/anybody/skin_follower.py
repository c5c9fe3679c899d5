"""Weights of somebody before a webcam that follow the skin: each frame's face, laid flat, beside the frames before."""

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchface.capture.anybody.guided_gains import gain_factors, gain_groups
from torchface.capture.anybody.webcam_outputs import OCTAVES
from torchface.capture.anybody.webcam_state import WebcamControls, WebcamState
from torchface.capture.own_rig.eye_geometry import arkit_names
from torchface.capture.own_rig.flat_face import FlatFace
from torchface.capture.own_rig.skin_flow import LEAST_ERROR, UNSEEN, SkinFlow
from torchface.capture.own_rig.skin_motion import COVERED, COVERS, LEAST_PLACES, unless_shut
from torchface.geometry.cameras.calibration import assumed_calibration
from torchface.landmarks.images.networks.part_finder import PartFinder
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.temporal.one_euro import OneEuroSettings, one_euro_step

_STEP = 1.0  # millimetres a pixel of the flat face
_SOONEST = 1 / 40  # seconds after which the skin is looked at again: cameras of 60 frames a second need no more
_SETTLED = 1.0  # seconds of a face after which its first solves have come to rest: the reference begins
_GROWS, _CEASES = 1.0, 0.4  # seconds in which the skin comes to count as a face appears, and ceases to as one is lost
_LOOKS, _APART = 10, 30  # in which parts are found, and the frames from one to the next
_RENEWED = 10  # frames after which the reference is renewed; in the beginning at once
_LASTS = 150.0  # frames in whose mean the reference is
_KNOWN, _REMEMBERED = 30.0, 600.0  # frames that a mean change of 0 counts as, and in whose mean a change is
_UNSEEN = torch.tensor([name.startswith(UNSEEN) for name in ARKIT])
_CALM = OneEuroSettings(0.5, 8.0, 3.0)
_ANOTHER = 2.0  # millimetres of mean error, from which the reference shows another person: a hand leaves up to 1.6


class SkinFollower:
    """Follows the skin of one person from frame to frame, as ``skin_motion`` does in a whole take.

    The reference is the running mean of the frames, each brought onto it, so that it needs none that are yet to come:
    it begins when a face has been there for a second, and anew where another person takes over. A change counts beside
    the mean of those before it.

    Args:
        rig: that the frames' states are of, upright, in millimetres, with iBUG's 68 landmarks.
        parts: finds what is no skin.

    Source: Kroeger et al. 2016 for the flow.
    """

    def __init__(self, rig: BlendshapeRig, parts: PartFinder) -> None:
        self.names: tuple[str, ...] = tuple(rig.names)
        self._face, self._parts = FlatFace.of(rig, _STEP), parts
        self._groups, self._to_arkit = gain_groups(rig.names), mapping(rig.names, ARKIT).double()
        self.reset()

    def reset(self) -> None:
        """Forgets the person."""
        self._covered = torch.zeros(self._face.counts.shape)
        self._frames, self._since, self._counts = 0, math.inf, 0.0
        self._mean, self._share = np.zeros((2, *self._covered.shape), np.float32)
        self._flow: SkinFlow | None = None
        self._error = LEAST_ERROR
        self._usual = np.zeros(sum(not name.startswith(UNSEEN) for name in arkit_names(self.names)))
        self._change = self._speed = torch.zeros(len(self.names))

    def followed(
        self, picture: np.ndarray, state: WebcamState, interval: float, controls: WebcamControls | None = None
    ) -> Tensor:
        """A frame's weights by ARKit's names, (52,) in [0,1], as the skin changes those of its state.

        Args:
            picture: the frame, uint8 (H,W,3) or (H,W,4), red first.
            state: that was solved of it.
            interval: seconds since the frame before.
            controls: what the user asks for.
        """
        controls = controls or WebcamControls()
        if controls.reset:
            self.reset()
        face = float(state.lost) == 0 and float(state.shown) >= _SETTLED
        self._counts += (float(face) - self._counts) * (1 - math.exp(-interval / (_GROWS if face else _CEASES)))
        self._since += interval
        if face and self._since >= _SOONEST:
            opening = 2 ** (OCTAVES * (0.5 - controls.smoothing)) if controls.smoothing > 0 else math.inf
            frame = torch.from_numpy(np.ascontiguousarray(picture[..., :3])).permute(2, 0, 1)
            self._look(frame, state, min(self._since, 1.0), opening)
            self._since = 0.0
        shown = controls.gain * self._change.double() / gain_factors(state.gains.double(), self._groups)
        added = self._counts * (self._to_arkit @ shown)
        weights = state.weights.to(added)
        changed = unless_shut(weights, (weights + added).clamp(0, 1), ARKIT, _UNSEEN)
        return changed.to(state.weights)

    def _look(self, frame: Tensor, state: WebcamState, since: float, opening: float) -> None:
        """Takes a frame into the reference and the change."""
        if self._error > _ANOTHER:
            self.reset()
        pose = (state.pose[:9].reshape(3, 3), state.pose[9:])
        calibration = assumed_calibration(frame.shape[2], frame.shape[1])
        picture, seen, at = self._face.seen_in(frame, state.shapes, pose, calibration)
        picture, squarely = self._face.even(picture), np.round(255 * seen).astype(np.uint8)
        looks, due = divmod(self._frames, _APART)
        if due == 0 and looks < _LOOKS:
            covers = self._parts(frame, self._face.landmarks_in(at)).around(at, *COVERS).nan_to_num(1.0)
            self._covered += (covers - self._covered) / (looks + 1)
            self._flow = None
        if (by := self._beside()) is None:
            brought = picture
        else:
            flow, counts, brought = by.flow(picture, squarely)
            found, _, left = by.solved(flow, counts, max(self._error, LEAST_ERROR), self._usual)
            self._error += 0.05 * (left - self._error)
            self._usual += (found - self._usual) / (min(self._frames, _REMEMBERED) + _KNOWN)
            change = torch.zeros_like(self._change)
            change[by.shapes] = torch.from_numpy(found - self._usual).float()
            self._change, self._speed = one_euro_step(change, self._change, self._speed, since, _CALM, opening=opening)
        share = seen + 0.25
        self._share = np.minimum(self._share + share, _LASTS)
        self._mean += (brought - self._mean) * (share / self._share)
        self._frames += 1

    def _beside(self) -> SkinFlow | None:
        """The flow beside the frames before; None where there are none, or next to no skin is seen."""
        if self._flow is None and self._frames > 0:
            skin = self._face.counts & (self._covered < COVERED)
            if int(skin.sum()) >= LEAST_PLACES:
                face = replace(self._face, counts=skin)
                self._flow = SkinFlow.of(face, self.names, self._mean.astype(np.uint8))
        elif self._flow is not None and (self._frames < _RENEWED or self._frames % _RENEWED == 0):
            self._flow = self._flow.beside(self._mean.astype(np.uint8))
        return self._flow

"""Optical flow of a face laid flat beside a reference of its skin, and the small changes of weights that explain it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from torchface.capture.own_rig.eye_geometry import arkit_names
from torchface.capture.own_rig.flat_face import FlatFace, softened
from torchface.optim.blas_threads import one_blas_thread

LEAST_ERROR = 0.3
"""Of a flow, millimetres."""
UNSEEN = ("eyeBlink", "eyeLook", "tongue")
"""How the names of shapes begin that skin does not show."""

_EDGE = 2  # pixels beside what is not seen that do not count
_PLAIN = 36.0  # squared grey levels a pixel: skin whose contrast is less can hardly be followed
_OTHER = 20.0  # grey levels by which skin differs that is something else: a hand, hair, a fold
_TOGETHER = 16  # pixels within which flows err together
_THIN = 3  # pixels from one that counts to the next
_REWEIGHTINGS = 2
# What a take's solution varies by about its mean error, 1.5 times that of twelve rendered films; brows of real skin are
# off by more. Places are off by what the pose is: to the sides and up, millimetres, then by turns, radians.
_VARIES = {
    "brow": 0.12, "eyeWide": 0.15, "eyeSquint": 0.12, "cheekSquint": 0.11, "noseSneer": 0.08, "mouthSmile": 0.09,
    "mouthFrown": 0.08, "mouthDimple": 0.045, "mouthStretch": 0.07, "mouthRoll": 0.045, "mouthPress": 0.04,
    "jawOpen": 0.05, "mouthClose": 0.024, "mouthLeft": 0.045, "mouthRight": 0.045, "jaw": 0.03, "cheekPuff": 0.023,
}  # fmt: skip
_USUALLY = 0.075
_POSE = (2.0, 2.0, 0.03, 0.03, 0.06, 0.06)


@dataclass(frozen=True, eq=False)
class SkinFlow:
    """The least squares of a flow: M shapes and six movements of the pose, at 2G values of G places."""

    reference: np.ndarray  # (H,W) uint8
    step: float
    shapes: list[int]  # of the rig's
    places: np.ndarray  # those that count, (H,W) bool
    skin: np.ndarray  # (H,W) float32
    contrast: tuple[np.ndarray, np.ndarray]  # how far a place can be followed to the side and up, (G,) in [0,1]
    moves: np.ndarray  # (M+6,2G) float32
    prior: np.ndarray  # precisions, (M+6,)

    @staticmethod
    def of(face: FlatFace, names: Sequence[str], reference: np.ndarray) -> "SkinFlow":
        called = arkit_names(names)
        shapes = [row for row, name in enumerate(called) if not name.startswith(UNSEEN)]
        places = np.zeros_like(reference, dtype=bool)
        places[::_THIN, ::_THIN] = face.counts.numpy()[::_THIN, ::_THIN]
        at = face.rest.numpy()[places]
        x, y, z = (at - [*np.median(at[:, :2], axis=0), at[:, 2].max()]).T
        one, none = np.ones_like(x), np.zeros_like(x)
        pose = np.stack([[one, none, y, x, none, z], [none, one, x, -y, z, none]])
        basis = face.basis[shapes].numpy()[:, places]
        moves = np.concatenate([np.stack([basis[..., 0], -basis[..., 1]]), pose], axis=1)
        varies = [
            next((off for start, off in _VARIES.items() if called[row].startswith(start)), _USUALLY) for row in shapes
        ]
        prior = np.array([*varies, *_POSE]) ** -2.0
        skin = face.counts.numpy().astype(np.float32)
        moves = moves.swapaxes(0, 1).reshape(len(prior), -1).astype(np.float32)
        none = np.zeros(0, np.float32)
        return SkinFlow(reference, face.step, shapes, places, skin, (none, none), moves, prior).beside(reference)

    def beside(self, reference: np.ndarray) -> "SkinFlow":
        """The same beside another reference of the skin, (H,W) uint8."""
        slopes = (cv2.Sobel(reference, cv2.CV_32F, *way, scale=1 / 8) for way in ((1, 0), (0, 1)))
        strong = [softened(slope**2, 2.0)[self.places] for slope in slopes]
        across, up = (one / (one + _PLAIN) for one in strong)
        return replace(self, reference=reference, contrast=(across, up))

    def flow(self, picture: np.ndarray, squarely: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How far from the reference's places a frame shows them, (2G,) millimetres; how far that counts, (2G,) in
        [0,1]; and the picture (H,W) brought onto the reference."""
        flow = optical_flow(self.reference, picture)
        brought = brought_back(picture, flow)
        other = np.abs(brought.astype(np.float32) - self.reference)
        counts = cv2.erode(squarely * (self.skin / 255), np.ones((2 * _EDGE + 1,) * 2, np.uint8))
        counts = (counts / (1 + (softened(other, 2.0) / _OTHER) ** 4))[self.places]
        across, up = self.contrast
        return self.step * flow[self.places].T.ravel(), np.concatenate([counts * across, counts * up]), brought

    def solved(
        self, flow: np.ndarray, counts: np.ndarray, error: float, expected: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """The shapes' change (M,) and its deviation (M,), of flows (2G,) with an error, and what is left of the flows;
        millimetres both. ``expected`` is the change that nothing seen leaves, (M,)."""
        robust, count = np.ones_like(flow), len(self.shapes)
        pull = np.pad(self.prior[:count] * expected, (0, len(self.prior) - count))
        with one_blas_thread():
            for _ in range(_REWEIGHTINGS):
                weighted = self.moves * (counts * robust * (_THIN / _TOGETHER / error) ** 2).astype(np.float32)
                H = (weighted @ self.moves.T).astype(np.float64) + np.diag(self.prior)
                solution = np.linalg.solve(H, weighted @ flow + pull)
                left = flow - solution.astype(np.float32) @ self.moves
                robust = 1 / (1 + (left / (2 * error)) ** 2)
        share = counts * robust
        remains = float(np.sqrt((share * left**2).sum() / max(float(share.sum()), 1e-9)))
        return solution[:count], np.sqrt(np.diag(np.linalg.inv(H)))[:count], remains


def optical_flow(reference: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Where a picture shows each place of the reference, beside that, (H,W,2) pixels."""
    solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    solver.setFinestScale(0)
    solver.setPatchStride(4)  # a third of the preset's time, and weights as near
    solver.setGradientDescentIterations(8)
    solver.setVariationalRefinementIterations(1)
    return solver.calc(reference, picture, np.zeros((*reference.shape, 2), np.float32))


def brought_back(picture: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """A picture (H,W) brought back along a flow from the reference."""
    y, x = np.indices(picture.shape, dtype=np.float32)
    return cv2.remap(picture, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

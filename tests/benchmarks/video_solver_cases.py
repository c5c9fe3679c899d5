"""Films of planted heads for the benchmark of the video solver, and the rows of its tables."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from image_fit_cases import Faces
from torch import Tensor

from planted.gaussian_density import gaussian
from torchface.capture import DynamicsPrior, ShapePrior, VideoSolver
from torchface.capture.own_rig import VideoSettings, solve_whole_take
from torchface.capture.own_rig.face_points import FacePoints
from torchface.capture.priors import ReciprocalPrior
from torchface.geometry.rotations import rotation_matrix
from torchface.rig import BlendshapeRig

K = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)


SIZE, FILL, NOISE = (640, 480), 0.5, 1.0


HEADS, FRAMES, SKIPPED = 10, 60, 5  # the first frames tell how a filter starts, not how it goes on


TEST = (4, 5)


STRENGTHS = (0.05, 0.1, 0.15, 0.3, 1.0)


@dataclass(frozen=True, eq=False)
class Shot:
    """A filmed head: the rig to solve with, the one it was filmed with, its weights (T,N) and landmarks (T,68,2)."""

    rig: BlendshapeRig
    true: BlendshapeRig
    weights: Tensor
    landmarks: Tensor
    rotation: Tensor
    translation: Tensor


def head(faces: Faces, seed: int) -> BlendshapeRig:
    """A random head that moves by the template's shapes."""
    generator = torch.Generator().manual_seed(seed)
    rest = faces.rig.vertices + torch.tensordot(torch.randn(20, generator=generator), faces.modes, dims=1)
    return BlendshapeRig(faces.rig.neutral.with_vertices(rest), faces.rig.deltas, faces.rig.names)


def with_correctives(rig: BlendshapeRig, seed: int, share: float = 0.15) -> BlendshapeRig:
    """Shapes of one's own: each delta changed by a smooth field of random directions, a share of its length."""
    generator = torch.Generator().manual_seed(1000 + seed)
    count, waves = len(rig.names), 6
    length = 60 + 60 * torch.rand(count, waves, 1, generator=generator)
    ways = torch.nn.functional.normalize(torch.randn(count, waves, 3, generator=generator), dim=-1) / length
    phase = torch.einsum("nwc,vc->nwv", 2 * math.pi * ways, rig.vertices)
    phase = phase + 2 * math.pi * torch.rand(count, waves, 1, generator=generator)
    field = torch.einsum("nwv,nwc->nvc", phase.sin(), torch.randn(count, waves, 3, generator=generator))
    field = field / field.square().sum(-1).mean(1).sqrt()[:, None, None]
    return BlendshapeRig(rig.neutral, rig.deltas + share * rig.deltas.norm(dim=-1, keepdim=True) * field, rig.names)


def wander(frames: int, sizes: list[float], seconds: float, generator: torch.Generator) -> Tensor:
    """Smooth motion of the sizes (C,), (T,C)."""
    at = torch.arange(frames).double()[:, None, None] / 60
    period = seconds * (0.6 + 1.2 * torch.rand(4, len(sizes), generator=generator).double())
    phase = 2 * math.pi * torch.rand(4, len(sizes), generator=generator).double()
    return torch.sin(2 * math.pi * at / period + phase).sum(1) * torch.tensor(sizes).double() / 2


def film(rig: BlendshapeRig, true: BlendshapeRig, weights: Tensor, seed: int) -> Shot:
    """A shot of weights (T,N): yaw to ±25°, pitch to ±12°, shifts of centimetres."""
    generator = torch.Generator().manual_seed(seed)
    turn = wander(len(weights), [0.10, 0.22, 0.06], 3.5, generator)
    shift = wander(len(weights), [12.0, 8.0, 20.0], 4.0, generator)
    rotation = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64)) @ rotation_matrix(turn)
    marks = true.neutral.landmarks
    middle = true.vertices[marks].double()
    away = float(K[0, 0]) * float(middle[:, 1].max() - middle[:, 1].min()) / (FILL * SIZE[1])
    far = torch.tensor([0.0, 0.0, away], dtype=torch.float64)
    translation = far - rotation @ middle.mean(0) + shift
    points = FacePoints.of(true, marks)
    w = weights.double()
    rows = points.chosen(w, rotation, translation, K)
    placed = points.at(w)[torch.arange(len(w))[:, None], rows]
    image = (placed @ rotation.mT + translation[:, None]) @ K.T
    pixels = image[..., :2] / image[..., 2:]
    pixels = pixels + NOISE * torch.randn(pixels.shape, generator=generator).double()
    return Shot(rig, true, w, pixels, rotation, translation)


def shots(faces: Faces, takes: tuple[int, ...], count: int, frames: int, first: int = 0) -> list[Shot]:
    """Heads that perform a stretch of the takes in turn."""
    found = []
    for seed in range(first, first + count):
        take = faces.takes[takes[seed % len(takes)]]
        begin = int(torch.randint(len(take) - frames, (1,), generator=torch.Generator().manual_seed(seed)))
        rig = head(faces, seed)
        found.append(film(rig, rig, take[begin : begin + frames], seed))
    return found


@dataclass
class Row:
    """Of all frames of all shots: vertices mm, weights mean and root mean square, jumps and jerks against the truth."""

    vertices: float
    weights: float
    square: float
    jump: float
    jerk: float
    milliseconds: float

    def line(self, name: str, against: "Row | None" = None) -> str:
        text = (
            f"{name:44s}{self.vertices:9.3f}{self.weights:9.4f}{self.square:9.4f}{self.jump:8.2f}{self.jerk:8.1f}"
            f"{self.milliseconds:9.1f}"
        )
        if against is None:
            return text
        gains = (self.vertices / against.vertices - 1, self.weights / against.weights - 1)
        return text + f"{gains[0]:+9.0%}{gains[1]:+9.0%}"


HEADING = f"{'':44s}{'vert mm':>9s}{'w mean':>9s}{'w rms':>9s}{'jump':>8s}{'jerk':>8s}{'CPU ms':>9s}" + 2 * "     gain"


def jumps(weights: Tensor) -> tuple[float, float]:
    """The hundredth largest of frame-to-frame jumps, and the mean second difference."""
    step = weights.diff(dim=0)
    return float(step.abs().amax(1).quantile(0.99)), float(step.diff(dim=0).abs().mean())


Solve = Callable[[Shot], Tensor]


def measured(filmed: list[Shot], solve: Solve) -> Row:
    vertices, errors, ratios = [], [], []
    start = time.process_time()
    found = [solve(shot) for shot in filmed]
    spent = (time.process_time() - start) / sum(len(w) for w in found)
    for shot, w in zip(filmed, found, strict=True):
        w = w[SKIPPED:].double()
        truth = shot.weights[SKIPPED:]
        some = slice(None, None, 7)  # vertices enough for a mean
        # What is shown is the solving rig at its weights; what was filmed, the true one's.
        off = torch.einsum("tn,nvc->tvc", w, shot.rig.deltas[:, some].double())
        off = off - torch.einsum("tn,nvc->tvc", truth, shot.true.deltas[:, some].double())
        vertices.append(off.norm(dim=-1).mean(1))
        errors.append(w - truth)
        ratios.append([a / b for a, b in zip(jumps(w), jumps(truth), strict=True)])
    error, ratio = torch.cat(errors), torch.tensor(ratios).mean(0)
    return Row(
        float(torch.cat(vertices).mean()),
        float(error.abs().mean()),
        float(error.square().mean().sqrt()),
        float(ratio[0]),
        float(ratio[1]),
        1e3 * spent,
    )


def by(prior: ShapePrior | None, dynamics: DynamicsPrior | None = None, **settings: float) -> Solve:
    weighed = VideoSettings(**settings)
    return lambda shot: VideoSolver(shot.rig, None, K, prior, dynamics, weighed)(shot.landmarks).weights


def whole(prior: ShapePrior, dynamics: DynamicsPrior, **settings: float) -> Solve:
    weighed = VideoSettings(**settings)
    return lambda shot: (
        solve_whole_take(VideoSolver(shot.rig, None, K, prior, dynamics, weighed), shot.landmarks).weights
    )


def one_gaussian(takes: list[Tensor], names: tuple[str, ...]) -> ShapePrior:
    """One Gaussian with full covariance, its floor as small as helps."""
    return ShapePrior(names, [range(len(names))], [gaussian(torch.cat(takes), variance=1e-5)])


def parzen(takes: list[Tensor], names: tuple[str, ...]) -> ShapePrior:
    """The paper's; every fifth frame of takes that hardly change in between."""
    return ReciprocalPrior.fit([take[::5] for take in takes], names)


FITS: dict[str, tuple[Callable[..., ShapePrior], float]] = {
    "the paper's Parzen window, λ/P": (parzen, 0.0),
    "one Gaussian": (one_gaussian, 0.0),
    "default": (ShapePrior.fit, 1.0),
}


def chosen(faces: Faces, train: tuple[int, ...]) -> tuple[dict[str, float], float]:
    """The strengths of each prior and of sparsity alone that solve takes left out best."""
    loss = {(name, s): 0.0 for name in FITS for s in STRENGTHS}
    sparse = dict.fromkeys((1.0, 3.0, 10.0), 0.0)
    for left in train:
        others = [faces.takes[k] for k in train if k != left]
        rig = head(faces, 500 + left)
        spaced = film(rig, rig, faces.takes[left][::45], 500 + left)
        for name, (fit, sparsity) in FITS.items():
            prior = fit(others, rig.names)
            for s in STRENGTHS:
                prior.strength = s * (30 if name.startswith("the paper") else 1)
                row = measured([spaced], by(prior, sparsity=sparsity))
                # Both kinds of error count, each in what it usually is.
                loss[name, s] += row.vertices / 0.25 + row.weights / 0.025
        for s in sparse:
            row = measured([spaced], by(None, sparsity=s))
            sparse[s] += row.vertices / 0.25 + row.weights / 0.025
    strengths = {name: min(STRENGTHS, key=lambda s: loss[name, s]) for name in FITS}
    return strengths, min(sparse, key=sparse.__getitem__)


class RandomWalk(torch.nn.Module):
    """Weights stay where they are, give or take what they moved in the takes: what a Gaussian process has to beat."""

    window = 1

    def __init__(self, takes: list[Tensor]) -> None:
        super().__init__()
        squares = torch.stack([take.double().diff(dim=0).square().mean(0) for take in takes]).mean(0)
        self.register_buffer("center", torch.zeros_like(squares))
        self.register_buffer("variance", 3 * squares + 1e-6)

    def require(self, names: tuple[str, ...]) -> None:
        pass

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        return windows[:, -1], self.variance.expand(len(windows), -1)


def table(filmed: list[Shot], ways: dict[str, Solve]) -> dict[str, Row]:
    print(HEADING)
    rows: dict[str, Row] = {}
    for name, solve in ways.items():
        rows[name] = measured(filmed, solve)
        print(rows[name].line(name, rows.get("one Gaussian")), flush=True)
    return rows

"""A UV landmark detector's bank of filters as ONNX: pictures to landmarks, in a fixed number of steps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import onnx
import torch
from kornia.filters import get_gaussian_kernel1d
from torch import Tensor, nn
from torch.nn.functional import conv2d, normalize, pad

from torchface import __version__
from torchface.errors import ShapeError
from torchface.landmarks import UVLandmarkDetector
from torchface.landmarks.scans.hog import CLIP, FAINT, cell_map
from torchface.landmarks.scans.uv_detector import FARTHEST
from torchface.onnx.checked_export import ExportReport, write_checked
from torchface.onnx.graph_builder import GraphBuilder
from torchface.rendering.gaussian_blur import kernel_size, unsharp

ROUNDS = 5
_PARITY = {"pixels": 0.5, "confidence": 0.02}
_UNITS = {"pixels": "pixels", "confidence": "of 1"}


class LandmarkBank(nn.Module):
    """What the graph computes, in PyTorch.

    As ``UVLandmarkDetector``, with mean shift in a fixed form: it starts at the place where most votes lie within a
    bandwidth, weighed by the prior, and takes five steps. A cluster's size is the votes within a bandwidth of its
    centre.

    Args:
        detector: with L landmarks, learned from M images of S×S pixels.
    """

    filters: Tensor
    mean_cell: Tensor
    good: Tensor
    bad: Tensor
    near: Tensor
    disc: Tensor
    places: Tensor
    prior_mean: Tensor
    axes: Tensor
    spread: Tensor
    noise: Tensor

    def __init__(self, detector: UVLandmarkDetector) -> None:
        super().__init__()
        settings = detector.settings
        self.settings, self.size, self.names = settings, detector.size, detector.names
        self.channels = 3 if detector.appearance == "texture" else 1
        self.appearance = detector.appearance
        hog, count = settings.hog, len(detector.names)
        self.images, self.side = detector.filters.shape[1], detector.size // hog.stride + 1
        self.register_buffer(
            "filters", normalize(detector.filters.flatten(2), dim=2, eps=1e-9).view_as(detector.filters)
        )
        self.register_buffer("mean_cell", detector.mean_cell.view(1, -1, 1, 1))
        self.register_buffer("good", detector.good)
        self.register_buffer("bad", detector.bad)
        line = hog.positions(torch.arange(self.side)).float()
        places = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1).view(-1, 2)
        offset = places[None] - detector.prior_mean[:, None]
        spread, axes = torch.linalg.eigh(detector.prior_covariance.double())
        squared = ((offset.double() @ axes) ** 2 / spread[:, None]).sum(-1)
        self.register_buffer("near", (torch.exp(-0.5 * squared) * (squared < FARTHEST**2)).float())
        reach = int(settings.bandwidth // hog.stride)
        across = torch.arange(-reach, reach + 1) * float(hog.stride)
        disc = (across[:, None] ** 2 + across**2 <= settings.bandwidth**2).float()
        self.register_buffer("disc", disc[None, None])
        self.register_buffer("places", places)
        self.register_buffer("prior_mean", detector.prior_mean)
        self.register_buffer("axes", axes.float())
        self.register_buffer("spread", spread.float())
        self.register_buffer("noise", detector.noise.view(count, 1))

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (B,L,2) and confidence (B,L) of images (B,C,S,S) in [0,1]."""
        if images.ndim != 4 or images.shape[1:] != (self.channels, self.size, self.size):
            raise ShapeError(
                f"images: found {tuple(images.shape)}, expected (B,{self.channels},{self.size},{self.size})"
            )
        settings, count = self.settings, len(self.names)
        hog = settings.hog
        cells = cell_map(unsharp(images, settings.unsharp_sigma, settings.unsharp_amount), hog) - self.mean_cell
        step = hog.cell // hog.stride
        reach = (hog.side - 1) * step // 2
        wide = pad(cells, (reach,) * 4, mode="replicate")
        product = conv2d(wide, self.filters.flatten(0, 1), dilation=step)
        energy = conv2d(wide.square().sum(1, keepdim=True), torch.ones(1, 1, hog.side, hog.side), dilation=step)
        scores = (product / energy.clamp(min=1e-18).sqrt()).view(len(images), count, self.images, -1)
        least = scores.topk(settings.matches, -1).values[..., -1:]
        good = (scores >= least) & (scores >= settings.similarity_threshold) & self._more_likely_good(scores)
        votes = good.float().sum(2)
        square = votes.view(-1, 1, self.side, self.side)
        density = conv2d(pad(square, (self.disc.shape[-1] // 2,) * 4), self.disc).view_as(votes)
        centre = self.places[(density * self.near).argmax(-1)]
        for _ in range(ROUNDS):
            inside = self._inside(votes, centre)
            centre = (inside @ self.places) / inside.sum(-1, keepdim=True).clamp(min=1)
        size = self._inside(votes, centre).sum(-1, keepdim=True)
        believed = (density * self.near).amax(-1, keepdim=True) > 0
        share = size / (self.images * settings.matches) * believed.float()
        along = ((centre - self.prior_mean)[..., None, :] @ self.axes)[..., 0, :]
        kept = along * (self.spread * share / (self.spread * share + self.noise))
        return self.prior_mean + (self.axes @ kept[..., None])[..., 0], share[..., 0]

    def _inside(self, votes: Tensor, centre: Tensor) -> Tensor:
        """The votes (B,L,P) within a bandwidth of centres (B,L,2)."""
        away = (self.places - centre[..., None, :]).square().sum(-1)
        return votes * (away <= self.settings.bandwidth**2).float()

    def _more_likely_good(self, scores: Tensor) -> Tensor:
        clipped = torch.minimum(scores, self.good[None, ..., :1])
        likely = ((clipped - self.good[..., :1]) / self.good[..., 1:]) ** 2 + 2 * self.good[..., 1:].log()
        unlikely = ((clipped - self.bad[..., :1]) / self.bad[..., 1:]) ** 2 + 2 * self.bad[..., 1:].log()
        return likely <= unlikely


def export_landmark_bank(
    detector: UVLandmarkDetector,
    path: str | Path,
    facts: Mapping[str, object] | None = None,
    images: Tensor | None = None,
) -> ExportReport:
    """Writes a detector's bank, and checks it.

    The graph takes ``images`` (B,C,S,S) in [0,1], three channels for a detector of textures, one for a detector of
    relief, and gives ``pixels`` (B,L,2), x right and y down, and ``confidence`` (B,L) in [0,1]. The metadata holds
    ``landmark_names`` and ``appearance``.

    Args:
        detector: with what it has learned.
        path: the file to write.
        facts: further metadata, such as licence and data.
        images: to check with; cloudy noise if absent.

    Raises:
        ValueRangeError: ONNX Runtime and PyTorch differ; nothing is written.
    """
    bank = LandmarkBank(detector).eval()
    if images is None:
        generator = torch.Generator().manual_seed(0)
        coarse = torch.rand(2, bank.channels, 24, 24, generator=generator)
        images = nn.functional.interpolate(coarse, size=(bank.size, bank.size), mode="bicubic").clamp(0, 1)
    cases = []
    with torch.no_grad():
        for part in (images[:1], images):
            pixels, confidence = bank(part)
            cases.append(({"images": part}, {"pixels": pixels, "confidence": confidence}))
    return write_checked(landmark_bank_model(bank, facts), path, cases, _PARITY, _UNITS)


def landmark_bank_model(bank: LandmarkBank, facts: Mapping[str, object] | None = None) -> onnx.ModelProto:
    """The graph of :class:`LandmarkBank`."""
    build = GraphBuilder()
    op, constant = build.op, build.constant
    settings, count = bank.settings, len(bank.names)
    scores = _scores(build, bank)
    least = op("ReduceMin", _top(build, scores, settings.matches), axes=[-1], keepdims=1)
    good, bad = bank.good[None], bank.bad[None]
    usual = constant("good_mean", good[..., :1])
    clipped = op("Min", scores, usual)
    distances = []
    for name, table in (("good", good), ("bad", bad)):
        away = op(
            "Div",
            op("Sub", clipped, constant(f"{name}_mean", table[..., :1])),
            constant(f"{name}_spread", table[..., 1:]),
        )
        distances.append(op("Add", op("Mul", away, away), constant(f"{name}_log", 2 * table[..., 1:].log())))
    kept = op("And", op("LessOrEqual", *distances), op("GreaterOrEqual", scores, least))
    kept = op("And", kept, op("GreaterOrEqual", scores, constant("threshold", settings.similarity_threshold)))
    votes = op("ReduceSum", op("Cast", kept, to=onnx.TensorProto.FLOAT), constant("second", (2,)), keepdims=0)
    square = op("Reshape", votes, constant("square", (-1, 1, bank.side, bank.side)))
    constant("disc", bank.disc)
    density = op("Conv", square, "disc", pads=[bank.disc.shape[-1] // 2] * 4)
    value = op("Mul", op("Reshape", density, constant("flat", (-1, count, bank.side**2))), constant("near", bank.near))
    centre = op("Gather", constant("places", bank.places), op("ArgMax", value, axis=-1, keepdims=0), axis=0)
    constant("reach", float(settings.bandwidth**2))
    constant("one", 1.0)
    constant("rows", bank.places[None, None])
    last = constant("last", (-1,))

    def inside(centre: str) -> str:
        apart = op("Sub", "rows", op("Unsqueeze", centre, constant("third", (2,))))
        away = op("ReduceSum", op("Mul", apart, apart), last, keepdims=0)
        return op("Mul", votes, op("Cast", op("LessOrEqual", away, "reach"), to=onnx.TensorProto.FLOAT))

    for _ in range(ROUNDS):
        held = inside(centre)
        total = op("Max", op("ReduceSum", held, last, keepdims=1), "one")
        centre = op("Div", op("MatMul", held, "places"), total)
    size = op("ReduceSum", inside(centre), last, keepdims=1)
    most = op("ReduceMax", value, axes=[-1], keepdims=1)
    believed = op("Cast", op("Greater", most, constant("nothing", 0.0)), to=onnx.TensorProto.FLOAT)
    share = op("Mul", op("Div", size, constant("all", float(bank.images * settings.matches))), believed)
    mean = constant("prior_mean", bank.prior_mean[None])
    constant("axes", bank.axes[None])
    constant("turned_axes", bank.axes.transpose(1, 2)[None])
    offset = op("Unsqueeze", op("Sub", centre, mean), "third")
    along = op("Squeeze", op("MatMul", offset, "axes"), "third")
    strength = op("Mul", constant("spread", bank.spread[None]), share)
    along = op("Mul", along, op("Div", strength, op("Add", strength, constant("noise", bank.noise[None]))))
    moved = op("Squeeze", op("MatMul", op("Unsqueeze", along, "third"), "turned_axes"), "third")
    op("Add", mean, moved, output="pixels")
    op("Squeeze", share, last, output="confidence")
    return build.model(
        "uv_landmark_bank",
        {"images": ("batch", bank.channels, bank.size, bank.size)},
        {"pixels": ("batch", count, 2), "confidence": ("batch", count)},
        {
            "task": "uv_landmarks",
            "landmark_names": list(bank.names),
            "appearance": bank.appearance,
            "units": "pixels",
            "version": __version__,
            **(facts or {}),
        },
    )


def _scores(build: GraphBuilder, bank: LandmarkBank) -> str:
    """Cosines (B,L,M,P): the pre-filter, gradients, cells and the filters, all of them convolutions."""
    op, constant = build.op, build.constant
    settings, channels = bank.settings, bank.channels
    hog = settings.hog
    kernel = get_gaussian_kernel1d(kernel_size(settings.unsharp_sigma), settings.unsharp_sigma)
    kernel = kernel.expand(channels, 1, 1, -1)
    reach = kernel.shape[-1] // 2
    wide = op("Pad", "images", constant("around", (0, 0, reach, reach, 0, 0, reach, reach)), mode="edge")
    blurred = op("Conv", wide, constant("across", kernel), group=channels)
    blurred = op("Conv", blurred, constant("down", kernel.transpose(2, 3)), group=channels)
    detail = op("Mul", op("Sub", "images", blurred), constant("amount", float(settings.unsharp_amount)))
    padded = op("Pad", op("Add", "images", detail), constant("rim", (0, 0, 1, 1, 0, 0, 1, 1)), mode="edge")
    slope = torch.tensor([-0.5, 0.0, 0.5]).expand(channels, 1, 1, 3)
    x = op("Conv", padded, constant("slope_x", slope), group=channels)
    y = op("Conv", padded, constant("slope_y", slope.transpose(2, 3)), group=channels)
    # A derivative along one axis keeps the rim of the other: cut it.
    constant("first", (1,))
    constant("end", (-1,))
    x = op("Slice", x, "first", "end", constant("height", (2,)))
    y = op("Slice", y, "first", "end", constant("width", (3,)))
    steep = op("Add", op("Mul", x, x), op("Mul", y, y))
    if channels > 1:
        best = op("ArgMax", steep, axis=1, keepdims=1)
        x, y, steep = (op("GatherElements", one, best, axis=1) for one in (x, y, steep))
    constant("nought", 0.0)
    # Orientation over half a turn needs no quadrant; where x is 0 the quotient is infinite, which is right.
    safe = op("Where", op("Equal", x, "nought"), constant("tiny", 1e-30), x)
    turn = op("Mul", op("Atan", op("Div", y, safe)), constant("per_turn", hog.bins / torch.pi))
    turn = op("Where", op("Less", turn, "nought"), op("Add", turn, constant("bins", float(hog.bins))), turn)
    apart = op("Abs", op("Sub", turn, constant("orientations", torch.arange(hog.bins).view(1, -1, 1, 1).float())))
    apart = op("Min", apart, op("Sub", "bins", apart))
    vote = op("Mul", op("Relu", op("Sub", constant("unit", 1.0), apart)), op("Sqrt", steep))
    cells = op("AveragePool", vote, kernel_shape=[hog.cell] * 2, strides=[hog.stride] * 2, pads=[hog.cell // 2] * 4,
               count_include_pad=1)  # fmt: skip
    constant("channels", (1,))
    energy = op("ReduceSum", op("Mul", cells, cells), "channels", keepdims=1)
    area = 2 * hog.cell // hog.stride
    around = op("AveragePool", energy, kernel_shape=[area + 1] * 2, pads=[area // 2] * 4, count_include_pad=0)
    cells = op("Div", cells, op("Sqrt", op("Add", around, constant("faint", FAINT**2))))
    cells = op("Sub", op("Sqrt", op("Min", cells, constant("clip", CLIP))), constant("mean_cell", bank.mean_cell))
    step = hog.cell // hog.stride
    rim = (hog.side - 1) * step // 2
    cells = op("Pad", cells, constant("window", (0, 0, rim, rim, 0, 0, rim, rim)), mode="edge")
    product = op("Conv", cells, constant("filters", bank.filters.flatten(0, 1)), dilations=[step] * 2)
    length = op("ReduceSum", op("Mul", cells, cells), "channels", keepdims=1)
    length = op("Conv", length, constant("ones", torch.ones(1, 1, hog.side, hog.side)), dilations=[step] * 2)
    cosine = op("Div", product, op("Sqrt", op("Max", length, constant("least_length", 1e-18))))
    return op("Reshape", cosine, constant("by_filter", (-1, len(bank.names), bank.images, bank.side**2)))


def _top(build: GraphBuilder, scores: str, count: int) -> str:
    return build.first_of_two("TopK", scores, build.constant("matches", (count,)), axis=-1)

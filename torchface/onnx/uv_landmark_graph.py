"""A UV landmark detector's bank of filters as ONNX: images to landmarks, in a fixed number of steps."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, normalize, pad

from torchface.errors import ShapeError
from torchface.landmarks import UVLandmarkDetector
from torchface.landmarks.scans.hog import cell_map
from torchface.landmarks.scans.uv_detector import MAX_DISTANCE
from torchface.onnx.checked_export import ExportReport, export_checked
from torchface.rendering.gaussian_blur import unsharp

MEAN_SHIFT_STEPS = 5
_PARITY = {"pixels": 0.5, "confidence": 0.02}
_UNITS = {"pixels": "pixels", "confidence": "of 1"}


class LandmarkBank(nn.Module):
    """What the graph computes, in PyTorch.

    As ``UVLandmarkDetector``, with mean shift in a fixed form: it starts at the place where most votes lie within a
    bandwidth, weighed by the prior, and takes five steps. A cluster's size is the votes within a bandwidth of its
    centre.
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
    variances: Tensor
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
        variances, axes = torch.linalg.eigh(detector.prior_covariance.double())
        squared = ((offset.double() @ axes) ** 2 / variances[:, None]).sum(-1)
        self.register_buffer("near", (torch.exp(-0.5 * squared) * (squared < MAX_DISTANCE**2)).float())
        reach = int(settings.bandwidth // hog.stride)
        across = torch.arange(-reach, reach + 1) * float(hog.stride)
        disc = (across[:, None] ** 2 + across**2 <= settings.bandwidth**2).float()
        self.register_buffer("disc", disc[None, None])
        self.register_buffer("places", places)
        self.register_buffer("prior_mean", detector.prior_mean)
        self.register_buffer("axes", axes.float())
        self.register_buffer("variances", variances.float())
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
        scores = (product / energy.clamp(min=1e-18).sqrt()).view(-1, count, self.images, self.side**2)
        least = scores.topk(settings.matches, -1).values[..., -1:]
        good = (scores >= least) & (scores >= settings.similarity_threshold) & self._more_likely_good(scores)
        votes = good.float().sum(2)
        square = votes.view(-1, 1, self.side, self.side)
        density = conv2d(pad(square, (self.disc.shape[-1] // 2,) * 4), self.disc).view_as(votes)
        centre = self.places[(density * self.near).argmax(-1)]
        for _ in range(MEAN_SHIFT_STEPS):
            inside = self._inside(votes, centre)
            centre = (inside @ self.places) / inside.sum(-1, keepdim=True).clamp(min=1)
        size = self._inside(votes, centre).sum(-1, keepdim=True)
        near_prior = (density * self.near).amax(-1, keepdim=True) > 0
        fraction = size / (self.images * settings.matches) * near_prior.float()
        along = ((centre - self.prior_mean)[..., None, :] @ self.axes)[..., 0, :]
        kept = along * (self.variances * fraction / (self.variances * fraction + self.noise))
        return self.prior_mean + (self.axes @ kept[..., None])[..., 0], fraction[..., 0]

    def _inside(self, votes: Tensor, centre: Tensor) -> Tensor:
        """The votes (B,L,P) within a bandwidth of centres (B,L,2)."""
        squared_distance = (self.places - centre[..., None, :]).square().sum(-1)
        return votes * (squared_distance <= self.settings.bandwidth**2).float()

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
    curvature, and gives ``pixels`` (B,L,2), x right and y down, and ``confidence`` (B,L) in [0,1]. The metadata holds
    ``landmark_names`` and ``appearance``.

    Args:
        images: to check with; cloudy noise if absent.
    """
    bank = LandmarkBank(detector).eval()
    if images is None:
        generator = torch.Generator().manual_seed(0)
        coarse = torch.rand(2, bank.channels, 24, 24, generator=generator)
        images = nn.functional.interpolate(coarse, size=(bank.size, bank.size), mode="bicubic").clamp(0, 1)
    cases = []
    with torch.no_grad():
        for part in (images[:1], torch.cat([images[:1], images])):
            pixels, confidence = bank(part)
            cases.append(({"images": part}, {"pixels": pixels, "confidence": confidence}))
    metadata = {
        "task": "uv_landmarks",
        "landmark_names": list(bank.names),
        "appearance": bank.appearance,
        "units": "pixels",
        **(facts or {}),
    }
    return export_checked(bank, path, cases, _PARITY, _UNITS, metadata)

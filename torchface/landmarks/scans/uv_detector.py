"""Landmarks in UV space by a bank of HOG filters, the scores they give, and where landmarks usually lie."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.scans.detector_settings import DetectorSettings
from torchface.landmarks.scans.face_frame import FaceFrame
from torchface.landmarks.scans.hog import cell_map, similarity, unit_windows, windows
from torchface.landmarks.scans.line_shape import REACH, STATIONS, LineShape
from torchface.landmarks.scans.score_statistics import best_scores, score_statistics
from torchface.landmarks.scans.uv_landmark_names import LINES, UV_LANDMARK_NAMES
from torchface.mesh import Mesh
from torchface.optim.data_dependent import data_dependent
from torchface.optim.mean_shift import mean_shift
from torchface.rendering.gaussian_blur import unsharp

MAX_DISTANCE = 4.5  # standard deviations from the usual place beyond which nothing is believed
_PRIOR_FLOOR = 2.0  # pixels; landmarks set by hand are not surer than that


class UVLandmarks(NamedTuple):
    """Found landmarks: ``pixels`` (B,L,2), x right and y down, and ``confidence`` (B,L) in [0,1], 0 where only the
    prior speaks."""

    pixels: Tensor
    confidence: Tensor


@dataclass(frozen=True, eq=False)
class LineExamples:
    """Lip and lid lines of images that a detector learns from.

    Args:
        lines: pixels of each image's lines by name, (N,2) from left to right, where known.
        images: that they are traced in, (M,C,S,S), where these are others than those that show the landmarks.

    Example:
        >>> lips = {"lips": torch.tensor([[10.0, 20.0], [14.0, 19.0]])}
        >>> LineExamples([lips, {}]).images is None  # the second image's lines are not known
        True
    """

    lines: Sequence[Mapping[str, Tensor]]
    images: Tensor | None = None


class UVLandmarkDetector(nn.Module):
    r"""Finds landmarks in images that share a UV space, roughly.

    Every training image gives a HOG filter a landmark. A filter's scores near its landmark in the other images, and
    elsewhere, are two Gaussians; the location of a landmark is a third:

    .. math:: s \in \text{good} \iff \mathcal{N}(s; \mu_g, \sigma_g) \ge \mathcal{N}(s; \mu_b, \sigma_b), \qquad
       \hat{x} = \arg\max_{c} |c| \; \mathcal{N}(\bar{x}_c; \mu, \Sigma)

    over the clusters c that mean shift makes of the good ones among every filter's best 200 matches.

    Beyond the thesis, a found place is weighed against the usual one by its error, for its size, when each
    training image was searched with the filters of the others: a landmark that filters cannot find (a cheek without
    texture) stays near its usual place,

    .. math:: x = \mu + \Sigma (\Sigma + r^2 \tfrac{s}{|c|} I)^{-1} (\hat{x} - \mu)

    with s the usual cluster size and r the usual error.

    Args:
        images: how many training images there were.
        size: side of the square images, pixels.
        names: of the landmarks.
        appearance: what the images show, "texture" or "curvature".
        settings: how to match; a dict as in ``config`` will do.
        frame: config of the ``FaceFrame`` that scans are aligned with, where there is one.

    Source: thesis 3.2.2.

    Example:
        >>> from torchface import zoo
        >>> from torchface.synthetic import neutral_head
        >>> detector = zoo.get_model("uv_landmarks")
        >>> len(detector.names), detector.sees(neutral_head(texture=False))  # looks at colours
        (12, False)
    """

    filters: Tensor
    mean_cell: Tensor
    good: Tensor
    bad: Tensor
    prior_mean: Tensor
    prior_covariance: Tensor
    noise: Tensor
    line_statistics: Tensor
    line_profiles: Tensor
    corner_deviation: Tensor

    def __init__(
        self,
        images: int,
        size: int = 1024,
        names: tuple[str, ...] = UV_LANDMARK_NAMES,
        appearance: str = "texture",
        settings: DetectorSettings | dict[str, Any] | None = None,
        frame: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if appearance not in ("texture", "curvature"):
            raise ValueRangeError(f"appearance: found {appearance!r}, expected 'texture' or 'curvature'")
        self.names, self.size, self.appearance = tuple(names), size, appearance
        self.settings = DetectorSettings.of(settings)
        self.frame = None if frame is None else FaceFrame(**frame)
        hog, count = self.settings.hog, len(self.names)
        self.register_buffer("filters", torch.zeros(count, images, hog.bins, hog.side, hog.side))
        self.register_buffer("mean_cell", torch.zeros(hog.bins))
        self.register_buffer("good", torch.zeros(count, images, 2))
        self.register_buffer("bad", torch.zeros(count, images, 2))
        self.register_buffer("prior_mean", torch.zeros(count, 2))
        self.register_buffer("prior_covariance", torch.zeros(count, 2, 2))
        self.register_buffer("noise", torch.zeros(count))
        self.register_buffer("line_statistics", torch.zeros(len(LINES), 2, STATIONS))
        self.register_buffer("line_profiles", torch.zeros(len(LINES), STATIONS, 2 * REACH + 1))
        self.register_buffer("corner_deviation", torch.zeros(count))

    @property
    def config(self) -> dict[str, Any]:
        """What the constructor needs: plain values only."""
        return {
            "images": self.filters.shape[1],
            "size": self.size,
            "names": list(self.names),
            "appearance": self.appearance,
            "settings": asdict(self.settings),
            "frame": None if self.frame is None else self.frame.config,
        }

    def sees(self, mesh: Mesh) -> bool:
        """Whether a scan has what this detector looks at: colours, if it learned from those."""
        textured = mesh.texture is not None and mesh.uvs is not None and mesh.uv_faces is not None
        return self.appearance == "curvature" or textured or mesh.colors is not None

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> "UVLandmarkDetector":
        """A detector of zeros for the state to be loaded into."""
        if config.get("appearance") == "relief":  # the name in older models
            config = {**config, "appearance": "curvature"}
        return cls(**config)

    @classmethod
    def fit(
        cls,
        images: Tensor,
        landmarks: Tensor,
        names: tuple[str, ...] = UV_LANDMARK_NAMES,
        appearance: str = "texture",
        settings: DetectorSettings | None = None,
        frame: FaceFrame | None = None,
        lines: LineExamples | None = None,
        progress: Any = None,
    ) -> "UVLandmarkDetector":
        """Learns from annotated images.

        Args:
            images: (M,C,S,S) in [0,1], at least two.
            landmarks: pixels, (M,L,2); NaN where one is not known (at most all but two of the images).
            names: of the L landmarks.
            appearance: what the images show, "texture" or "curvature".
            settings: how to match.
            frame: the frame the images were unwrapped in, kept for ``scan_landmarks``.
            lines: where lips and lids run in the images, where known: tracing starts from their mean and looks for
                what they look like.
            progress: called with the number of images done and in all.

        Raises:
            ShapeError: images and landmarks do not fit each other.
            ValueRangeError: fewer than two images, a landmark that fewer than two have, or images with NaN or infinity.
        """
        _check_training(images, landmarks, names)
        images, landmarks = images.detach(), landmarks.detach()
        self = cls(len(images), images.shape[-1], names, appearance, settings, None if frame is None else frame.config)
        if frame is not None and self.frame is not None:
            self.frame.load_state_dict(frame.state_dict())
        self._fit_prior(landmarks)
        maps = [self._raw_cells(image[None])[0] for image in images]
        self.mean_cell.copy_(torch.stack([cells.mean((1, 2)) for cells in maps]).mean(0))
        hog = self.settings.hog
        places = hog.rows(torch.nan_to_num(landmarks))
        for i, cells in enumerate(maps):
            self.filters[:, i] = windows(cells - self.mean_cell[:, None, None], hog, places[i])
        self.filters[~torch.isfinite(landmarks).all(-1).T] = 0.0
        centred = [cells - self.mean_cell[:, None, None] for cells in maps]
        scores = score_statistics(centred, self.filters, landmarks, self.settings, progress)
        self.good.copy_(scores.good)
        self.bad.copy_(scores.bad)
        self._fit_noise(scores.best, scores.places, maps[0].shape[-1], landmarks)
        if lines is not None:
            self._fit_lines(lines.lines, images if lines.images is None else lines.images)
        return self

    @data_dependent("to keep the detector, which finds a scan's landmarks once")
    def forward(self, images: Tensor) -> UVLandmarks:
        """Landmarks of images (B,C,S,S) in [0,1].

        Raises:
            ShapeError: images of another size than those learned from.
            ValueRangeError: images with NaN or infinity.
        """
        if images.ndim != 4 or images.shape[-2:] != (self.size, self.size):
            raise ShapeError(f"images: found {tuple(images.shape)}, expected (B,C,{self.size},{self.size})")
        _check_finite(images)
        pixels = self.prior_mean.repeat(len(images), 1, 1)
        confidence = torch.zeros(pixels.shape[:2], dtype=pixels.dtype, device=pixels.device)
        for b, image in enumerate(images):  # one image's responses are 100 MB; a batch of them would be too much
            cells = self._cells(image[None])
            columns, width = unit_windows(cells, self.settings.hog), cells.shape[-1]
            for k in range(len(self.names)):
                pixels[b, k], confidence[b, k] = self._locate(k, columns, width)
        return UVLandmarks(pixels, confidence)

    def matches(self, landmark: int, columns: Tensor, width: int) -> tuple[Tensor, Tensor]:
        """Where a landmark's filters match: pixels (N,2), and how many filters found each (N,).

        Args:
            landmark: which one.
            columns: the windows of one image's centred map, see ``unit_windows``.
            width: of that map.
        """
        scores = similarity(columns, self.filters[landmark])[0]
        return self._votes(landmark, *best_scores(scores, self.settings.matches), width)

    def _votes(
        self, landmark: int, best: Tensor, place: Tensor, width: int, without: int | None = None
    ) -> tuple[Tensor, Tensor]:
        good = (best >= self.settings.similarity_threshold) & self._more_likely_good(landmark, best)
        if without is not None:
            good[without] = False
        places, votes = place[good].unique(return_counts=True)
        return self.settings.hog.positions(torch.stack([places % width, places // width], dim=-1)), votes

    def _locate(self, landmark: int, columns: Tensor, width: int) -> tuple[Tensor, Tensor]:
        best, share = self._best_cluster(landmark, *self.matches(landmark, columns, width))
        return self._weighed(landmark, best, share), share

    def _weighed(self, landmark: int, place: Tensor, share: Tensor) -> Tensor:
        """A found place between itself and the usual one."""
        if float(share) <= 0:
            return place
        mean, covariance = self.prior_mean[landmark], self.prior_covariance[landmark]
        error = self.noise[landmark] / share * torch.eye(2, dtype=mean.dtype, device=mean.device)
        # The share of all matches is both the cluster's size and how sure it is of itself.
        return mean + covariance @ torch.linalg.solve(covariance + error, place - mean)

    def _best_cluster(self, landmark: int, points: Tensor, votes: Tensor) -> tuple[Tensor, Tensor]:
        """Centre of the best cluster of matches, and its share of all the matches that there could be."""
        mean, covariance = self.prior_mean[landmark], self.prior_covariance[landmark]
        if len(points) == 0:
            return mean, mean.new_zeros(())
        clusters = mean_shift(points, self.settings.bandwidth, votes)
        offset = clusters.centres - mean
        squared = (offset * torch.linalg.solve(covariance, offset.T).T).sum(-1)
        near = torch.exp(-0.5 * squared) * (squared < MAX_DISTANCE**2)
        value = clusters.sizes * near
        best = int(value.argmax())
        if float(value[best]) <= 0:
            return mean, mean.new_zeros(())
        return clusters.centres[best], clusters.sizes[best] / (self.filters.shape[1] * self.settings.matches)

    def _more_likely_good(self, landmark: int, scores: Tensor) -> Tensor:
        """Whether scores (M,R) of a landmark's filters are likelier among the good than among the bad."""
        mean_good, deviation_good = self.good[landmark, :, :1], self.good[landmark, :, 1:]
        mean_bad, deviation_bad = self.bad[landmark, :, :1], self.bad[landmark, :, 1:]
        # Above the mean of the good, a score can only be better: a wide Gaussian of bad ones is ignored there.
        clipped = torch.minimum(scores, mean_good)
        likely = -0.5 * ((clipped - mean_good) / deviation_good) ** 2 - deviation_good.log()
        unlikely = -0.5 * ((clipped - mean_bad) / deviation_bad) ** 2 - deviation_bad.log()
        return likely >= unlikely

    def _fit_prior(self, landmarks: Tensor) -> None:
        mean = landmarks.nanmean(0)
        offset = torch.nan_to_num(landmarks - mean)
        count = torch.isfinite(landmarks).all(-1).sum(0).clamp(min=2)
        covariance = torch.einsum("mli,mlj->lij", offset, offset) / (count - 1)[:, None, None]
        self.prior_mean.copy_(mean)
        self.prior_covariance.copy_(covariance + _PRIOR_FLOOR**2 * torch.eye(2, dtype=covariance.dtype))

    def _fit_noise(self, best: Tensor, place: Tensor, width: int, landmarks: Tensor) -> None:
        """The usual error of landmarks in images searched with the filters of the others: the squared error a
        coordinate of the clusters, times their share, and the error of the rows in the end. Medians: deaf to single
        failures."""
        images, count = landmarks.shape[:2]
        places, shares = self.prior_mean.repeat(images, 1, 1), torch.zeros(images, count)
        for i in range(images):
            for k in range(count):
                votes = self._votes(k, best[i, k], place[i, k], width, without=i)
                places[i, k], shares[i, k] = self._best_cluster(k, *votes)
        products = (places - landmarks).square().sum(-1) * shares
        products[shares <= 0] = torch.nan
        # The median of a chi-squared variable with two degrees of freedom is 2 ln 2.
        middle = products.nanmedian(0).values / (2 * math.log(2))
        self.noise.copy_(torch.nan_to_num(middle, nan=float(self.size)))
        for i in range(images):
            for k in range(count):
                places[i, k] = self._weighed(k, places[i, k], shares[i, k])
        # 1.48 medians of the absolute value are a normal variable's standard deviation.
        self.corner_deviation.copy_(1.48 * (places - landmarks)[..., 1].abs().nanmedian(0).values)

    def line_shapes(self) -> dict[str, LineShape]:
        """How the lines usually run and look, those that were annotated in training."""
        shapes = {}
        for row, (name, ends) in enumerate(LINES.items()):
            offset, deviation = self.line_statistics[row]
            if bool((deviation > 0).all()) and all(end in self.names for end in ends):
                corners = max(float(self.corner_deviation[self.names.index(end)]) for end in ends)
                shapes[name] = LineShape(offset, deviation, corners, self.line_profiles[row])
        return shapes

    def _fit_lines(self, lines: Sequence[Mapping[str, Tensor]], images: Tensor) -> None:
        for row, name in enumerate(LINES):
            known = [(one[name], image) for one, image in zip(lines, images, strict=False) if name in one]
            if len(known) >= 2:
                shape = LineShape.fit([line for line, _ in known], [image for _, image in known])
                self.line_statistics[row] = torch.stack([shape.offset, shape.deviation]).to(self.line_statistics)
                if shape.profile is not None:
                    self.line_profiles[row] = shape.profile.to(self.line_profiles)

    def _raw_cells(self, images: Tensor) -> Tensor:
        sharp = unsharp(images.float(), self.settings.unsharp_sigma, self.settings.unsharp_amount)
        return cell_map(sharp, self.settings.hog)

    def _cells(self, images: Tensor) -> Tensor:
        return self._raw_cells(images) - self.mean_cell[None, :, None, None]


def _check_finite(images: Tensor) -> None:
    if bad := (~images.isfinite()).flatten(1).any(1).nonzero()[:, 0].tolist():
        raise ValueRangeError(f"images: found NaN or infinity in row {bad[0]}, expected numbers in [0,1]")


def _check_training(images: Tensor, landmarks: Tensor, names: tuple[str, ...]) -> None:
    if images.ndim != 4 or images.shape[-1] != images.shape[-2]:
        raise ShapeError(f"images: found {tuple(images.shape)}, expected (M,C,S,S)")
    if landmarks.shape != (len(images), len(names), 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected ({len(images)},{len(names)},2)")
    _check_finite(images)
    known = torch.isfinite(landmarks).all(-1).sum(0)
    if len(images) < 2 or int(known.min()) < 2:
        raise ValueRangeError(
            f"fit: found {len(images)} images and a landmark known in {int(known.min()) if len(known) else 0}, "
            "expected every landmark in at least two"
        )

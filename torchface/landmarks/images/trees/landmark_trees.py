"""Landmarks in an image by a cascade of regression trees that compare pixels near the current landmarks."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, ValueRangeError
from torchface.files.documents import Value
from torchface.optim.full_precision import full_precision
from torchface.progress import Progress

if TYPE_CHECKING:
    from torchface.landmarks.images.trees.tree_training import TreeSettings

FAINTEST = 0.02  # spread of the grey values under which a face counts as having none, in [0,1]

_MAX_SIZES = {"landmarks": 10_000, "cascades": 1000, "trees": 100_000, "depth": 12, "features": 32_000}


class LandmarkTrees(nn.Module):
    r"""An ensemble of regression trees: landmarks of faces from grey images and boxes round the faces.

    It starts from the mean shape in the box. Each cascade reads ``features`` grey values, each at a place that is fixed
    relative to a landmark of the current shape, turned and scaled as the shape is; its trees compare pairs of them and
    add what their leaves hold:

    .. math:: S \leftarrow S + s R \sum_t \ell_t\bigl(g(S)\bigr), \qquad
        \text{left if } (g_a - g_b) / \sigma \le \theta

    with :math:`s R` the similarity from mean shape to S and :math:`\sigma` the spread of the grey values read, so that
    neither light nor contrast, nor size nor tilt of the face, nor the box's exact place matter. Leaves are int8, one
    scale a tree, on the principal components of what was left to learn in their cascade. Outside of an image its
    border goes on. A box that is NaN gives NaN.

    Args:
        landmarks: how many, L.
        cascades: how many, C.
        trees: a cascade, T.
        depth: comparisons from root to leaf.
        features: grey values a cascade, P.
        components: of the leaves, K.

    Source: thesis 4.2.2; Kazemi and Sullivan 2014.

    Example:
        >>> from torchface import zoo
        >>> trees = zoo.get_model("face_landmarks")
        >>> box = torch.tensor([[20.0, 20.0, 60.0, 60.0]])
        >>> found = trees(torch.full((1, 1, 100, 100), 0.5), box)
        >>> moved = trees(torch.full((1, 1, 100, 100), 0.5), box + torch.tensor([5.0, 0.0, 0.0, 0.0]))
        >>> (moved - found).mean((0, 1)).round(decimals=2).tolist()
        [5.0, 0.0]
    """

    mean: Tensor
    anchors: Tensor
    offsets: Tensor
    first: Tensor
    second: Tensor
    thresholds: Tensor
    leaves: Tensor
    scales: Tensor
    bases: Tensor

    def __init__(
        self,
        landmarks: int = 68,
        cascades: int = 10,
        trees: int = 500,
        depth: int = 5,
        features: int = 400,
        components: int = 40,
    ) -> None:
        super().__init__()
        sizes = {"landmarks": landmarks, "cascades": cascades, "trees": trees, "depth": depth, "features": features}
        for name, size in sizes.items():
            if not 1 <= size <= _MAX_SIZES[name]:
                raise ValueRangeError(f"{name}: found {size}, expected 1 to {_MAX_SIZES[name]}")
        if not 1 <= components <= 2 * landmarks:
            raise ValueRangeError(f"components: found {components}, expected 1 to {2 * landmarks}")
        self.sizes = {**sizes, "components": components}
        splits = (cascades, trees, 2**depth - 1)
        self.register_buffer("mean", torch.zeros(landmarks, 2))
        self.register_buffer("anchors", torch.zeros(cascades, features, dtype=torch.int64))
        self.register_buffer("offsets", torch.zeros(cascades, features, 2))
        self.register_buffer("first", torch.zeros(splits, dtype=torch.int64))
        self.register_buffer("second", torch.zeros(splits, dtype=torch.int64))
        self.register_buffer("thresholds", torch.zeros(splits))
        self.register_buffer("leaves", torch.zeros(cascades, trees, 2**depth, components, dtype=torch.int8))
        self.register_buffer("scales", torch.zeros(cascades, trees))
        self.register_buffer("bases", torch.zeros(cascades, components, 2 * landmarks))

    @classmethod
    def fit(
        cls,
        images: Sequence[Tensor],
        boxes: Tensor,
        landmarks: Tensor,
        settings: "TreeSettings | None" = None,
        progress: Progress | None = None,
        mirror: Sequence[int] | None = None,
        checkpoint: Path | None = None,
    ) -> "LandmarkTrees":
        """Learns landmarks from annotated images.

        Every image is started from several boxes near its own, half of them mirrored; a tree learns a share of what the
        trees before it left, its leaves rounded as they are stored, so that later trees make up for that too.

        Args:
            images: grey, uint8 (H,W), of any sizes.
            boxes: x, y, width, height of the faces, (M,4) pixels.
            landmarks: (M,L,2), pixels; NaN where one is not known.
            settings: how trees are grown.
            progress: called with each step and how far it is.
            mirror: which landmark each becomes in a mirrored image; iBUG's where there are 68, else nothing is
                mirrored.
            checkpoint: a file that is written after every cascade; where it is there, from the same images and
                settings, learning goes on from it, to the same result; a damaged one is named in a warning, and
                learning begins anew. It may be deleted afterwards.

        Raises:
            ShapeError: numbers of images, boxes and landmarks differ, or an image is no uint8 (H,W).
            ValueRangeError: a box is NaN or empty, a landmark is never seen, or a setting is out of range.
            FileFormatError: the checkpoint is of other images or settings.
        """
        from torchface.landmarks.images.trees.tree_training import fit_trees

        return fit_trees(images, boxes, landmarks, settings, progress, mirror, checkpoint)

    @property
    def config(self) -> dict[str, Any]:
        return dict(self.sizes)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> Self:
        return cls(**{name: size.whole() for name, size in Value("config", "", config).table().items()})

    def check_state(self) -> None:
        """Raises a ``ValueRangeError`` where a stored index points outside of what there is."""
        for name, limit in (("anchors", len(self.mean)), ("first", self.sizes["features"]),
                            ("second", self.sizes["features"])):  # fmt: skip
            values = getattr(self, name)
            if int(values.min()) < 0 or int(values.max()) >= limit:
                raise ValueRangeError(
                    f"{name}: found {int(values.min())} to {int(values.max())}, expected below {limit}"
                )
        if not float((self.mean - self.mean.mean(0)).abs().max()) > 0:
            raise ValueRangeError("landmarks: found a single place, expected at least two")

    def forward(self, images: Tensor, boxes: Tensor) -> Tensor:
        """Landmarks (B,L,2), pixels.

        Args:
            images: grey, (B,1,H,W) in [0,1].
            boxes: x, y, width, height of the faces, (B,4) pixels.

        Raises:
            ShapeError: other shapes.
        """
        if images.ndim != 4 or images.shape[1] != 1 or 0 in images.shape[2:]:
            raise ShapeError(f"images: found {tuple(images.shape)}, expected (B,1,H,W)")
        if boxes.shape != (len(images), 4):
            raise ShapeError(f"boxes: found {tuple(boxes.shape)}, expected ({len(images)},4)")
        return self.refine(images, initial_shapes(self.mean, boxes.to(self.mean)))

    def refine(self, images: Tensor, shapes: Tensor) -> Tensor:
        """Landmarks (B,L,2) from other starts than the mean shape in a box, such as where they were a frame ago.

        Args:
            images: grey, (B,1,H,W) in [0,1].
            shapes: (B,L,2), pixels.

        Raises:
            ShapeError: other shapes.
        """
        if shapes.shape != (len(images), *self.mean.shape):
            raise ShapeError(f"shapes: found {tuple(shapes.shape)}, expected {(len(images), *self.mean.shape)}")
        return self.refined(images, shapes.to(self.mean))

    @full_precision
    def refined(self, images: Tensor, shapes: Tensor) -> Tensor:
        """As :meth:`refine`; one image (1,1,H,W) may serve all faces."""
        for cascade in range(self.sizes["cascades"]):  # each starts where the one before ended
            rotation = similarity_to(self.mean, shapes)
            pixels = shapes[:, self.anchors[cascade]] + self.offsets[cascade] @ rotation.transpose(1, 2)
            step = self._step(cascade, read_grey(images, pixels).to(shapes)).view(-1, *self.mean.shape)
            shapes = shapes + step @ rotation.transpose(1, 2)
        return shapes

    def _step(self, cascade: int, grey: Tensor) -> Tensor:
        """What the trees of a cascade add for grey values (B,P): (B,2L), in the mean shape's frame."""
        grey = grey / grey.std(1, correction=0, keepdim=True).clamp(min=FAINTEST)
        # One index into flat tables: a graph reads those twice as quickly as tables of two axes.
        first, second, thresholds = (x[cascade].flatten() for x in (self.first, self.second, self.thresholds))
        tree = torch.arange(self.sizes["trees"], device=first.device)
        splits, leaves = self.first.shape[2], self.leaves.shape[2]
        node = torch.zeros(grey.shape[0], len(tree), dtype=torch.int64, device=first.device)
        for _ in range(self.sizes["depth"]):  # a level at a time, all trees of all faces together
            place = tree * splits + node
            difference = grey.gather(1, first[place]) - grey.gather(1, second[place])
            node = 2 * node + 1 + (difference > thresholds[place]).long()
        leaf = self.leaves[cascade].flatten(0, 1)[tree * leaves + node - splits]
        return self.scales[cascade] @ leaf.to(grey.dtype) @ self.bases[cascade]


def initial_shapes(mean: Tensor, boxes: Tensor) -> Tensor:
    """The mean shape (L,2), in units of a box, in each box (B,4): (B,L,2) pixels.

    A box that is no square counts as the square of the same middle and area.
    """
    side = (boxes[:, 2] * boxes[:, 3]).sqrt()[:, None, None]
    middle = boxes[:, :2] + boxes[:, 2:] / 2
    return middle[:, None] + side * (mean - 0.5)


def similarity_to(mean: Tensor, shapes: Tensor) -> Tensor:
    """Scale times rotation (B,2,2) that aligns the mean shape (L,2) with shapes (B,L,2) with least squared error."""
    mean = mean - mean.mean(0)
    centred = shapes - shapes.mean(1, keepdim=True)
    energy = mean.square().sum()
    along = (centred * mean).sum((1, 2)) / energy
    across = (centred[..., 1] * mean[:, 0] - centred[..., 0] * mean[:, 1]).sum(1) / energy
    return torch.stack([along, -across, across, along], dim=1).view(-1, 2, 2)


def read_grey(images: Tensor, pixels: Tensor) -> Tensor:
    """The nearest pixels' values (B,P) of images (B,1,H,W), or of one (1,1,H,W), at (B,P,2); the border goes on."""
    height, width = images.shape[2:]
    nearest = torch.nan_to_num(pixels).round()
    x, y = nearest[..., 0].clamp(0, width - 1).long(), nearest[..., 1].clamp(0, height - 1).long()
    # No len(): in torch.export's quick mode it makes the number of faces a constant, and the slow one follows.
    return images.flatten(1).expand(pixels.shape[0], -1).gather(1, y * width + x)

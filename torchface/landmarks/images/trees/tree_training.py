"""Training of regression trees: gradient boosting on shape-indexed pixel differences."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.checkpoints import checkpoint_key, read_checkpoint, write_checkpoint
from torchface.files.content_keys import content_key
from torchface.landmarks.images.ibug_68 import MIRROR_68
from torchface.landmarks.images.trees.landmark_trees import FAINTEST, LandmarkTrees, initial_shapes, similarity_to
from torchface.number_checks import checked_count
from torchface.progress import Progress, silent

_METHOD = "landmark trees/2"
_ROWS = 4096  # samples whose pixels are read at once
_MAX_PIXELS = 2**33
_MAX_DEPTH = 16  # 65,536 leaves a tree


@dataclass(frozen=True)
class TreeSettings:
    """How trees are grown.

    Args:
        cascades: how many.
        trees: a cascade.
        depth: comparisons from root to leaf.
        features: pixels a cascade, from which pairs are drawn.
        test_splits: pairs that are tried at every node; the best is kept.
        shrinkage: share of a leaf's mean that is taken; the trees after it learn the rest.
        oversampling: initial shapes an image.
        closeness: distance at which a pair is e times less likely to be tried than one at no distance, of the box.
        padding: how far beyond the mean shape pixels are drawn, of the box.
        components: of what is left to learn in a cascade, on which leaves are stored; 0 for all, twice the landmarks.
        split_samples: initial shapes on which a tree's splits are chosen; its leaves are the means of all. 0 for all.
        translation: standard deviation of the initial shapes' place, of the box.
        scale: standard deviation of the logarithm of the initial shapes' size.
        rotation: standard deviation of the initial shapes' tilt, degrees.
        gamma: standard deviation of the logarithm of the exponent that makes a sample's image lighter or darker.
        noise: added to the grey values, standard deviation, in [0,1].
        seed: of everything drawn.

    Example:
        >>> 2**TreeSettings(depth=4).depth  # leaves of a tree
        16
    """

    cascades: int = 10
    trees: int = 500
    depth: int = 5
    features: int = 400
    test_splits: int = 50
    shrinkage: float = 0.1
    oversampling: int = 20
    closeness: float = 0.1
    padding: float = 0.05
    components: int = 40
    split_samples: int = 8192
    translation: float = 0.06
    scale: float = 0.1
    rotation: float = 8.0
    gamma: float = 0.25
    noise: float = 0.01
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            least = 1 if name in ("cascades", "trees", "depth", "features", "test_splits", "oversampling") else 0
            if not value >= least:
                raise ValueRangeError(f"{name}: found {value}, expected at least {least}")
        checked_count("depth", self.depth, 1, _MAX_DEPTH)
        if not 0 < self.shrinkage <= 1 or not self.closeness > 0:
            raise ValueRangeError(
                f"found shrinkage {self.shrinkage} and closeness {self.closeness}, expected (0,1] and above 0"
            )


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples: which image (N,), mirrored or not (N,), gamma (N,), where to end (N,L,2); all images' pixels."""

    source: Tensor
    flipped: Tensor
    gamma: Tensor
    targets: Tensor
    pixels: Tensor
    origin: Tensor
    height: Tensor
    width: Tensor

    def grey(self, rows: Tensor, places: Tensor) -> Tensor:
        """Grey values (n,P) in [0,1] of the samples ``rows`` (n,) at (n,P,2)."""
        source = self.source[rows]
        wide, high = self.width[source][:, None], self.height[source][:, None]
        x, y = places[..., 0].round().long(), places[..., 1].round().long()
        x, y = x.clamp(min=0).minimum(wide - 1), y.clamp(min=0).minimum(high - 1)
        x = torch.where(self.flipped[rows][:, None], wide - 1 - x, x)
        grey = self.pixels[self.origin[source][:, None] + y * wide + x].float() / 255
        return grey ** self.gamma[rows][:, None]


def fit_trees(
    images: Sequence[Tensor],
    boxes: Tensor,
    landmarks: Tensor,
    settings: TreeSettings | None,
    progress: Progress | None,
    mirror: Sequence[int] | None,
    checkpoint: Path | None,
) -> LandmarkTrees:
    """See :meth:`LandmarkTrees.fit`."""
    settings = settings or TreeSettings()
    boxes, landmarks = boxes.detach().float(), landmarks.detach().float()
    _check(images, boxes, landmarks)
    count = landmarks.shape[1]
    if mirror is None and count == len(MIRROR_68):
        mirror = MIRROR_68
    components = min(settings.components or 2 * count, 2 * count)
    model = LandmarkTrees(count, settings.cascades, settings.trees, settings.depth, settings.features, components)
    generator = torch.Generator().manual_seed(settings.seed)
    samples, initial, mean = _draw_initial_shapes(images, boxes, landmarks, settings, mirror, generator)
    model.mean.copy_(mean)
    model.check_state()
    key, done, shapes = "", 0, initial
    if checkpoint is not None:
        key = content_key(_METHOD, images=images, boxes=boxes, landmarks=landmarks, settings=settings, mirror=mirror)
        done, shapes = _resume(checkpoint, key, model, initial)
    for cascade in range(done, settings.cascades):
        # A generator a cascade, so that what goes on from a checkpoint draws what it would have drawn.
        drawn = torch.Generator().manual_seed(1_000_003 * settings.seed + cascade + 1)
        shapes = _grow_cascade(model, cascade, samples, shapes, settings, drawn, progress or silent)
        if checkpoint is not None:
            state = {**model.state_dict(), "shapes": shapes, "done": torch.tensor([cascade + 1])}
            write_checkpoint(checkpoint, state, key)
    return model.eval()


def _check(images: Sequence[Tensor], boxes: Tensor, landmarks: Tensor) -> None:
    if boxes.shape != (len(images), 4) or landmarks.ndim != 3 or landmarks.shape[::2] != (len(images), 2):
        raise ShapeError(
            f"found {len(images)} images, boxes {tuple(boxes.shape)}, landmarks {tuple(landmarks.shape)}; "
            "expected M images, (M,4) and (M,L,2)"
        )
    if not len(images):
        raise ShapeError("images: found none, expected at least one")
    for i, image in enumerate(images):
        if image.ndim != 2 or image.dtype != torch.uint8 or 0 in image.shape:
            raise ShapeError(f"image {i}: found {image.dtype} {tuple(image.shape)}, expected uint8 (H,W)")
    if sum(image.numel() for image in images) > _MAX_PIXELS:
        raise ShapeError(f"images: found more than {_MAX_PIXELS} pixels in all, expected fewer; crop them")
    if not bool(torch.isfinite(boxes).all()) or not bool((boxes[:, 2:] > 0).all()):
        row = int((~torch.isfinite(boxes).all(1) | (boxes[:, 2:] <= 0).any(1)).nonzero()[0])
        raise ValueRangeError(f"box {row}: found {boxes[row].tolist()}, expected finite numbers and a positive size")
    never = ~torch.isfinite(landmarks).all(-1).any(0)
    if never.any():
        raise ValueRangeError(f"landmark {int(never.nonzero()[0])}: found in no image, expected in one at least")


def _draw_initial_shapes(
    images: Sequence[Tensor],
    boxes: Tensor,
    landmarks: Tensor,
    settings: TreeSettings,
    mirror: Sequence[int] | None,
    generator: torch.Generator,
) -> tuple[_Samples, Tensor, Tensor]:
    """The samples, their initial shapes (N,L,2) in pixels, and the mean shape (L,2) in units of a box."""
    side = (boxes[:, 2] * boxes[:, 3]).sqrt()[:, None, None]
    middle = (boxes[:, :2] + boxes[:, 2:] / 2)[:, None]
    mean = (0.5 + (landmarks - middle) / side).nanmean(0)
    if mirror is not None:
        mean = (mean + mean[list(mirror)] * torch.tensor([-1.0, 1.0]) + torch.tensor([1.0, 0.0])) / 2
    count, total = len(images), len(images) * settings.oversampling
    source = torch.arange(count).repeat(settings.oversampling)
    draw = torch.arange(settings.oversampling).repeat_interleave(count)
    flipped = (draw + source) % 2 == 1 if mirror is not None else torch.zeros(total, dtype=torch.bool)
    width = torch.tensor([image.shape[1] for image in images])
    height = torch.tensor([image.shape[0] for image in images])
    targets, placed = landmarks[source], boxes[source].clone()
    if mirror is not None:
        last = (width[source] - 1).float()
        across = targets[:, list(mirror)].clone()
        across[..., 0] = last[:, None] - across[..., 0]
        targets = torch.where(flipped[:, None, None], across, targets)
        placed[:, 0] = torch.where(flipped, last - placed[:, 0] - placed[:, 2], placed[:, 0])
    drawn = torch.randn(total, 5, generator=generator).clamp(-2.5, 2.5)
    drawn[:count, :4] = 0  # each image's own box among them
    size = (placed[:, 2] * placed[:, 3]).sqrt()
    initial = initial_shapes(mean, placed)
    centre = initial.mean(1, keepdim=True)
    angle, scale = drawn[:, 3] * (settings.rotation * torch.pi / 180), (settings.scale * drawn[:, 2]).exp()
    rotation = (
        torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], 1).view(-1, 2, 2) * scale[:, None, None]
    )
    initial = centre + (initial - centre) @ rotation.transpose(1, 2)
    initial = initial + (settings.translation * size[:, None] * drawn[:, :2])[:, None]
    sizes = torch.tensor([image.numel() for image in images])
    samples = _Samples(
        source,
        flipped,
        (settings.gamma * drawn[:, 4]).exp(),
        targets,
        torch.cat([image.reshape(-1) for image in images]),
        torch.cat([sizes.new_zeros(1), sizes.cumsum(0)[:-1]]),
        height,
        width,
    )
    return samples, initial, mean


def _grow_cascade(
    model: LandmarkTrees,
    cascade: int,
    samples: _Samples,
    shapes: Tensor,
    settings: TreeSettings,
    generator: torch.Generator,
    progress: Progress,
) -> Tensor:
    """Learns one cascade; the shapes (N,L,2) after it."""
    mean = model.mean
    low, high = mean.amin(0) - settings.padding, mean.amax(0) + settings.padding
    places = low + (high - low) * torch.rand(settings.features, 2, generator=generator)
    anchors = torch.cdist(places, mean).argmin(1)
    model.anchors[cascade] = anchors
    model.offsets[cascade] = (places - mean[anchors]).half().float()
    rotation = similarity_to(mean, shapes)
    # Pixels by rows: a split reads two of them, over all samples.
    grey = torch.empty(settings.features, len(shapes))
    for rows in torch.arange(len(shapes)).split(_ROWS):
        spots = shapes[rows][:, anchors] + model.offsets[cascade] @ rotation[rows].transpose(1, 2)
        read = samples.grey(rows, spots)
        read = read + settings.noise * torch.randn(read.shape, generator=generator)
        grey[:, rows] = (read / read.std(1, correction=0, keepdim=True).clamp(min=FAINTEST)).T
    missing = torch.nan_to_num(samples.targets - shapes) @ torch.linalg.inv(rotation).transpose(1, 2)
    missing = missing.flatten(1)
    _, axes = torch.linalg.eigh((missing.T @ missing).double())
    basis = axes.flip(1)[:, : model.sizes["components"]].T.float().half().float()
    model.bases[cascade] = basis
    residual = missing @ torch.linalg.pinv(basis.double()).float()
    before = residual.clone()
    likely = torch.exp(-torch.cdist(places, places) / settings.closeness).fill_diagonal_(0).flatten().double().cumsum(0)
    total = settings.cascades * settings.trees
    for tree in range(settings.trees):  # each learns what those before it left
        _grow_tree(model, cascade, tree, grey, residual, likely, settings, generator)
        progress("growing trees", cascade * settings.trees + tree + 1, total)
    step = ((before - residual) @ basis).view_as(shapes)
    return shapes + step @ rotation.transpose(1, 2)


def _grow_tree(
    model: LandmarkTrees,
    cascade: int,
    tree: int,
    grey: Tensor,
    residual: Tensor,
    likely: Tensor,
    settings: TreeSettings,
    generator: torch.Generator,
) -> None:
    """Grows one tree on grey values (P,N) and subtracts its prediction from the residual (N,K)."""
    features, count = grey.shape
    # Starts that follow each other are of different images: a run of them is as good as a draw, and is no copy.
    some = min(settings.split_samples or count, count)
    begin = int(torch.randint(count - some + 1, (), generator=generator))
    wanted = residual[begin : begin + some]
    node = torch.zeros(some, dtype=torch.int64)
    every, column, flat = torch.zeros(count, dtype=torch.int64), torch.arange(count), grey.view(-1)
    for level in range(settings.depth):
        nodes, start = 2**level, 2**level - 1
        tests = (nodes, settings.test_splits)
        drawn = torch.rand(tests, generator=generator, dtype=torch.float64) * likely[-1]
        pair = torch.searchsorted(likely, drawn, right=True).clamp(max=features**2 - 1)
        first, second = pair // features, pair % features
        picked = torch.rand(tests, generator=generator)
        rows = node.argsort(stable=True).split(torch.bincount(node, minlength=nodes).tolist())
        best, threshold, right = torch.zeros(nodes, dtype=torch.int64), torch.zeros(nodes), torch.zeros_like(node)
        for one, members in enumerate(rows):  # a node at a time: they hold different numbers of samples
            if not len(members):
                continue
            place = begin + members
            difference = flat[(first[one] * count)[:, None] + place] - flat[(second[one] * count)[:, None] + place]
            # A threshold is what a sample of the node has, so that no test is idle; a half, as it is stored.
            sample = (picked[one] * len(members)).long()
            limits = difference.gather(1, sample[:, None])[:, 0].half().float()
            sides = (difference > limits[:, None]).float()
            best[one] = best_test(sides, wanted[members])
            threshold[one] = limits[best[one]]
            right[members] = sides[best[one]].long()
        pair = pair.gather(1, best[:, None])[:, 0]
        first, second = pair // features, pair % features
        model.first[cascade, tree, start : start + nodes] = first
        model.second[cascade, tree, start : start + nodes] = second
        model.thresholds[cascade, tree, start : start + nodes] = threshold
        node = 2 * node + right
        apart = flat[first[every] * count + column] - flat[second[every] * count + column]
        every = 2 * every + (apart > threshold[every]).long()
    leaves = 2**settings.depth
    number = torch.bincount(every, minlength=leaves).clamp(min=1)
    value = torch.zeros(leaves, residual.shape[1]).index_add_(0, every, residual) / number[:, None]
    value = settings.shrinkage * value
    scale = (value.abs().max() / 127).clamp(min=1e-12)
    stored = (value / scale).round().to(torch.int8)
    model.leaves[cascade, tree] = stored
    model.scales[cascade, tree] = scale
    residual -= (scale * stored.float())[every]


def best_test(right: Tensor, wanted: Tensor) -> Tensor:
    r"""The test that lowers the squared error of a node most.

    It is the one with the largest :math:`\lVert s_l \rVert^2 / n_l + \lVert s_r \rVert^2 / n_r`, s the sums of what is
    wanted on its two sides.
    """
    sums, number = right @ wanted, right.sum(1)
    other, rest = wanted.sum(0) - sums, right.shape[1] - number
    gain = sums.square().sum(1) / number.clamp(min=1) + other.square().sum(1) / rest.clamp(min=1)
    return gain.argmax()


def _resume(path: Path, key: str, model: LandmarkTrees, shapes: Tensor) -> tuple[int, Tensor]:
    """How many cascades a checkpoint holds, and the shapes after them; it is read into the model."""
    if checkpoint_key(path) not in (None, key):
        raise FileFormatError(
            f"{path}: found a checkpoint of other images or settings, or of another version; expected one of these; "
            "delete it"
        )
    state = read_checkpoint(path, key)
    if state is None:
        return 0, shapes
    done, shapes = int(state.pop("done")), state.pop("shapes")
    model.load_state_dict(state)
    model.check_state()
    return done, shapes

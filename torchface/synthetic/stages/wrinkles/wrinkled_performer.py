"""A performer at high resolution whose skin wrinkles: the truth for detail that a coarse animation lacks."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.meshes.operators import border_edges, components
from torchface.mesh import Mesh
from torchface.number_checks import check_rate
from torchface.rig import BlendshapeRig
from torchface.shape_names import mirror
from torchface.synthetic.head.performer import performer
from torchface.synthetic.stages.wrinkles.dense_surface import dense_surface
from torchface.synthetic.stages.wrinkles.skin_texture_relief import pore_heights
from torchface.synthetic.stages.wrinkles.wrinkle_lines import wrinkle_lines
from torchface.synthetic.stages.wrinkles.wrinkle_relief import wrinkle_relief

_LEAST_COMPRESSION = 0.04  # below it a rig's largest compression is taken to be this: no wrinkle comes from noise


def steady_folding(compression: Tensor, scale: Tensor, trace: Tensor) -> Tensor:
    """How far skin folds that is held compressed, 1 minus the stretch, in [0,1], (T,G); stretching takes the trace
    away.

    ``scale`` (G,) is the compression at which 1 - 1/e of the way is done.
    """
    folded = 1 - (-compression.clamp(min=0) / scale).exp()
    flattened = (compression.clamp(max=0) / scale).exp()
    return (trace + (1 - trace) * folded) * flattened


def with_lag(folding: Tensor, fps: float, fold_time: float, unfold_time: float) -> Tensor:
    """Folding (T,G) as skin shows it: a first-order low-pass, fast as it folds and slow as it unfolds; time
    constants in seconds."""
    fold, unfold = (1 - math.exp(-1 / (fps * time)) for time in (fold_time, unfold_time))
    shown = torch.empty_like(folding)
    shown[:1] = folding[:1]
    for frame in range(1, len(folding)):  # each frame depends on the one before
        change = folding[frame] - shown[frame - 1]
        shown[frame] = shown[frame - 1] + torch.where(change > 0, fold * change, unfold * change)
    return shown


def extreme_weights(names: Sequence[str]) -> Tensor:
    """Every shape alone at weight 1, and every one together with its mirror image, (E,N)."""
    single = torch.eye(len(names))
    pair = (single + single[mirror(names)]).clamp(max=1)
    return torch.cat([single, pair]).unique(dim=0)


def compression_scale(extremes: Tensor, line: Tensor, places: Sequence[str]) -> Tensor:
    """The compression that folds each line's skin by 1 - 1/e: half of what the rig's extremes (E,G) reach, (G,).

    So a rig that compresses skin less than skin does still wrinkles. Lines of one name share a scale.
    """
    most = extremes.amax(0)
    scale = torch.empty_like(most)
    for place in set(places):
        of_place = torch.tensor([name == place for name in places])[line]
        scale[of_place] = 0.5 * most[of_place].quantile(0.7).clamp(min=_LEAST_COMPRESSION)
    return scale


FOLD_TIME, UNFOLD_TIME = 0.040, 0.150
"""Seconds in which skin folds and unfolds by 1 - 1/e of the way."""

_NUMBERS_AT_ONCE = 2**23
_MOST_VERTICES = 2_000_000
_LANDMARKS = 68
_NOT_SKIN = ("eyeball_left", "eyeball_right", "eye_sockets", "mouth_interior", "ear_left", "ear_right")
_BACK, _NECK, _CROWN = 3.0, -140.0, 30.0  # millimetres: what is behind, below, and above-and-behind is left out
_RIM_ITERATIONS = 30


class WrinkledPerformer:
    r"""A face of many vertices whose wrinkles deepen where skin is compressed across them and unfold with a lag.

    .. math:: x = S\,(A_0 + \sum_i w_i \Delta_i) + F(w)\,(p + R\,[a,\, a^2])

    with :math:`S` the subdivision, :math:`F` the skin's own frame (normal and two tangents that stretch with it),
    :math:`p` pores, and :math:`R` the relief of wrinkles folded by :math:`a`. Folding grows with the compression of
    the smooth skin across each line and saturates; it follows in time as a first-order low-pass.

    Args:
        identity: coefficients of the embedded performer, see ``performer``; the mean if absent.
        vertices: how many the dense mesh is to have, about.
        seed: of where wrinkles and pores lie.
        rig: another rig with 68 landmarks in place of the embedded performer.

    Raises:
        ValueRangeError: ``identity`` beside ``rig``, or ``vertices`` below the coarse rig's or above two million;
            the rig has no landmarks.

    Example:
        >>> face = WrinkledPerformer(vertices=10000)
        >>> smile = torch.zeros(60, len(face.names), dtype=torch.float32)
        >>> smile[30:, face.rig.index(["mouthSmileLeft"])] = 1
        >>> folding = face.folding(smile, fps=60.0).amax(1)
        >>> bool(folding[29] < folding[32] < folding[59])
        True
    """

    def __init__(
        self, identity: Tensor | None = None, vertices: int = 100_000, seed: int = 0, rig: BlendshapeRig | None = None
    ) -> None:
        if rig is not None and identity is not None:
            raise ValueRangeError("WrinkledPerformer: found identity and rig, expected one of them")
        self.rig = performer_face(identity) if rig is None else rig
        marks = self.rig.neutral.landmarks
        if len(marks) != _LANDMARKS:
            raise ValueRangeError(f"WrinkledPerformer: found a rig of {len(marks)} landmarks, expected {_LANDMARKS}")
        least = len(self.rig.vertices)
        if not least <= vertices <= _MOST_VERTICES:
            raise ValueRangeError(
                f"vertices: found {vertices}, expected from {least}, which the coarse rig has, to {_MOST_VERTICES}"
            )
        self.names = self.rig.names
        surface = dense_surface(self.rig.neutral, vertices)
        self._operator, self._tangents = surface.operator, surface.tangents
        self.lines = wrinkle_lines(surface.neutral, seed)
        relief = wrinkle_relief(surface.neutral, self.lines)
        self._relief, self._along, self._trace = relief.relief, relief.along, relief.trace
        self._pores = pore_heights(surface.neutral, seed)
        self._across = ((relief.before - relief.behind) @ self._operator.astype("float64")).tocsr()
        self._rest = self._spans(torch.zeros(1, len(self.names)))[0]
        extremes = self.compression(extreme_weights(self.names))
        self._scale = compression_scale(extremes, relief.line, [line.place for line in self.lines])
        self.gauge_lines = relief.line
        self.neutral: Mesh = surface.neutral.with_vertices(self._posed(torch.zeros(1, len(self.names)), None)[0])

    def subdivided(self, weights: Tensor) -> Tensor:
        """The skin without pores or wrinkles, (T,V,3): Catmull-Clark of the posed coarse rig."""
        self._check(weights)
        return self._in_batches(weights, lambda some, rows: self._dense(self._operator, some))

    def smooth(self, weights: Tensor) -> Tensor:
        """The neutral, with its pores and faint lines, moved by the rig alone, (T,V,3)."""
        self._check(weights)
        return self._posed(weights, None)

    def frames(self, weights: Tensor, fps: float) -> Tensor:
        """The truth, (T,V,3), millimetres.

        Args:
            weights: (T,N), in the order of ``names``; one frame, and the first, is as if held for long.
            fps: frames a second.

        Raises:
            ShapeError: weights are not (T,N).
            ValueRangeError: a weight is NaN or infinite, or ``fps`` is not above 0.
        """
        self._check(weights)
        return self._posed(weights, self.folding(weights, fps))

    def folding(self, weights: Tensor, fps: float) -> Tensor:
        """How far skin has folded at each gauge of each line, in [0,1], (T,G)."""
        check_rate(fps, "WrinkledPerformer", ValueRangeError)
        self._check(weights)
        steady = steady_folding(self.compression(weights), self._scale, self._trace)
        return with_lag(steady, fps, FOLD_TIME, UNFOLD_TIME)

    def compression(self, weights: Tensor) -> Tensor:
        """How much the smooth skin is compressed across each line, (T,G): 1 minus its stretch."""
        shortened = 1 - self._spans(weights) / self._rest
        return (torch.from_numpy(self._along @ shortened.double().numpy().T).T).float()

    def _spans(self, weights: Tensor) -> Tensor:
        return self._dense(self._across, weights).norm(dim=-1)

    def _posed(self, weights: Tensor, folding: Tensor | None) -> Tensor:
        """Dense vertices (T,V,3) with pores and with wrinkles folded as given (T,G), or as at rest."""
        resting = self._displacement(self._trace[None])

        def pose(some: Tensor, rows: slice) -> Tensor:
            moved = resting if folding is None else self._displacement(folding[rows])
            dense = self._dense(self._operator, some)
            first, second = self._dense(self._tangents, some).chunk(2, dim=1)
            normal = torch.nn.functional.normalize(torch.linalg.cross(first, second), dim=-1)
            dense += normal.mul_(moved[:, :, 0:1] + self._pores[:, None])
            dense += first.mul_(moved[:, :, 1:2])
            dense += second.mul_(moved[:, :, 2:3])
            return dense

        return self._in_batches(weights, pose)

    def _displacement(self, folding: Tensor) -> Tensor:
        """In the skin's frame, (T,V,3), of folding (T,G)."""
        powers = torch.stack([folding, folding.square()], dim=-1).flatten(1)
        moved = torch.from_numpy(self._relief @ np.ascontiguousarray(powers.numpy().T))
        return moved.view(3, -1, len(folding)).permute(2, 1, 0)

    def _dense(self, matrix: sparse.csr_array, weights: Tensor) -> Tensor:
        """Coarse vertices at the weights through a matrix (R,V0), (T,R,3)."""
        coarse = self.rig(weights.to(self.rig.vertices)).detach().permute(1, 0, 2).flatten(1)
        moved = torch.from_numpy(matrix @ coarse.contiguous().numpy().astype(matrix.dtype, copy=False))
        return moved.view(len(moved), len(weights), 3).permute(1, 0, 2).contiguous()

    def _in_batches(self, weights: Tensor, pose: Callable[[Tensor, slice], Tensor]) -> Tensor:
        count = self._operator.shape[0]
        frames = torch.empty(len(weights), count, 3)
        size = max(1, _NUMBERS_AT_ONCE // (9 * count))
        for start in range(0, len(weights), size):  # batches of frames: all tangents at once would take gigabytes
            rows = slice(start, min(start + size, len(weights)))
            frames[rows] = pose(weights[rows], rows)
        return frames

    def _check(self, weights: Tensor) -> None:
        if weights.ndim != 2 or weights.shape[1] != len(self.names):
            raise ShapeError(f"weights: found {tuple(weights.shape)}, expected (T,{len(self.names)})")
        if not torch.isfinite(weights).all():
            bad = (~torch.isfinite(weights)).any(0).nonzero()[:, 0].tolist()
            named = ", ".join(self.names[i] for i in bad[:5])
            raise ValueRangeError(f"weights: NaN or infinite in {named}; expected finite numbers")


def performer_face(identity: Tensor | None = None) -> BlendshapeRig:
    """Skin from the neck to the crown and before the ears, with 68 landmarks and regions.

    Eyes and the inside of the mouth are left out: lids and lips are borders, as in a captured mesh.
    """
    head = performer(identity, texture=False)
    face = head.part(captured_skin(head))
    return BlendshapeRig(face.neutral.with_vertices(_smooth_rim(face.neutral)), face.deltas, face.names)


def captured_skin(head: BlendshapeRig) -> Tensor:
    """Which vertices of a performer are of that part, (V,) bool."""
    places, regions = head.neutral.vertices, head.neutral.regions
    hidden = torch.stack([regions[name] for name in _NOT_SKIN]).any(0)
    front = places[:, 2] > _BACK + 0.6 * (places[:, 1] - _CROWN).clamp(min=0)
    return ~hidden & front & (places[:, 1] > _NECK)


def _smooth_rim(cut: Mesh) -> Tensor:
    """Vertices (V,3) whose longest border is smooth; the cut along edges has left it in steps."""
    opposite = border_edges(cut.faces)
    pairs = torch.cat([cut.faces[:, [corner - 2, corner - 1]][opposite[:, corner]] for corner in range(3)])
    loop = components(torch.cat([pairs, pairs[:, :1]], dim=1), len(cut.vertices))[pairs[:, 0]]
    start, end = pairs[loop == loop.mode().values].T
    start, end = torch.cat([start, end]), torch.cat([end, start])
    rim, vertices = start.unique(), cut.vertices.clone()
    for _ in range(_RIM_ITERATIONS):
        beside = torch.zeros_like(vertices).index_add_(0, start, vertices[end])
        vertices[rim] = 0.5 * vertices[rim] + 0.25 * beside[rim]
    return vertices

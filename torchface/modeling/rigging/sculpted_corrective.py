"""A corrective made from a sculpted mesh: what an artist changes where a rig's shapes act together or half-way."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.correctives import Corrective, Correctives
from torchface.errors import AlignmentError, NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.unit_check import check_unit, extent
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh
from torchface.number_checks import as_tensor, checked_type
from torchface.rig import BlendshapeRig
from torchface.shape_names import mirror

# Millimetres: less is what files round; a shift of less moves nothing that is seen.
_CHANGED, _SHIFTED = 1e-3, 0.05
# A motion of the whole mesh leaves less than this share of the median distance where it is all that the median shows.
_EXPLAINED = 0.1
_SAME_PEAK = 1e-4
# Of the mesh's extent, the median distance at which it is no sculpt of this rig; heads differ by less.
_FAR = 0.03
# Of the square of the change, what other weights of the drivers and their mirror images explain at another pose.
_ANOTHER_POSE = 0.7
_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class SculptedCorrective:
    """A rig with a corrective that was made from a sculpt.

    Args:
        rig: with the corrective.
        definition: of the corrective.
        activation: how far it is on at the pose.
        change: what the sculpt changes at the pose, (V,3), millimetres.
        within: correctives of more shapes, all of its own among them, whose poses the new one changes too.
    """

    rig: BlendshapeRig
    definition: Corrective
    activation: float
    change: Tensor
    within: tuple[str, ...]

    def lines(self) -> list[str]:
        """What the sculpt changes, for people to read."""
        far = self.change.norm(dim=-1)
        moved = far > _CHANGED
        when = " x ".join(self.definition.drivers)
        when += "" if self.definition.peak is None else f" at {self.definition.peak:g}"
        lines = [
            f"{self.definition.name} ({when}): the sculpt changes {int(moved.sum()):,} of {len(far):,} vertices, by up "
            f"to {float(far.max()):.3g} mm, {float(far[moved].mean()):.3g} in the mean{self._where(far)}"
        ]
        if self.activation < 0.999:
            lines.append(
                f"the corrective is {self.activation:.3g} on at this pose; where it is fully on it moves vertices by "
                f"up to {float(far.max()) / self.activation:.3g} mm"
            )
        drivers = torch.as_tensor(self.rig.index(self.definition.drivers))
        both = torch.cat([drivers, mirror(self.rig.names)[drivers]]).unique()  # a sculpt of the other side is known too
        deltas = self.rig.deltas[both].flatten(1).cpu().double()
        steps = torch.linalg.lstsq(deltas.T, self.change.flatten()[:, None], driver="gelsd").solution[:, 0]
        if float((steps @ deltas).square().sum()) > _ANOTHER_POSE * float(self.change.square().sum()):
            other = " ".join(
                f"{self.rig.names[shape]}{step:+.2f}" for shape, step in zip(both.tolist(), steps.tolist(), strict=True)
            )
            lines.append(f"warning: {other} is most of the change; was the mesh sculpted at another pose?")
        if self.within:
            lines.append(f"warning: it acts at the poses of {', '.join(self.within)} too, whose faces it changes")
        return lines

    def _where(self, far: Tensor) -> str:
        notes = self.rig.neutral.annotations
        regions = {} if notes is None else notes.regions
        means = {name: float(far[mask].mean()) for name, mask in regions.items() if bool(mask.any())}
        most = [name for name in sorted(means, key=lambda name: -means[name])[:3] if means[name] > _CHANGED]
        if most:
            return f"; most in {', '.join(f'{name} ({means[name]:.2g} mm)' for name in most)}"
        middle = (far[:, None] * self.rig.vertices.to(far)).sum(0) / far.sum()
        return f"; about ({', '.join(f'{value:.0f}' for value in middle.tolist())}) mm"


def corrective_from_sculpt(
    rig: BlendshapeRig, weights: Tensor, sculpt: Tensor, name: str | None = None, replace: bool = False
) -> SculptedCorrective:
    r"""The rig with a corrective that makes it show a sculpt at a pose, and that is 0 where one of its drivers is.

    .. math:: D = \frac{s - A'(w)}{a(w)}

    with the rig A' that has the corrective with a delta of 0, so that other correctives act as they will beside it. The
    drivers are the shapes whose weight is not 0: two to eight are a combination; one below 1 is an in-between whose
    peak is its weight.

    Args:
        rig: N shapes, V vertices.
        weights: the pose, (N,), in [0,1].
        sculpt: vertices (V,3) in the rig's order, millimetres.
        name: of the corrective; if absent its drivers' joined by ``_``, an in-between's with its peak in percent.
        replace: take the place of a corrective that acts at the same combination or peak.

    Raises:
        ShapeError: ``sculpt`` is of another size.
        ValueRangeError: a weight outside [0,1], none above 0, one alone at 1, or a sculpt that changes nothing.
        NameMismatchError: more than eight drivers, a name that is taken, or a corrective that acts there already.

    Example:
        >>> face, names = torch.eye(3), ["smile", "jaw"]
        >>> rig = BlendshapeRig.from_tensors(face, torch.tensor([[0, 1, 2]]), torch.ones(2, 3, 3), names)
        >>> made = corrective_from_sculpt(rig, torch.tensor([1.0, 0.5]), face + 2.5)
        >>> made.definition.name, made.rig(torch.tensor([[1.0, 0.5]]))[0, 0].tolist()
        ('smile_jaw', [3.5, 2.5, 2.5])
    """
    checked_type("rig", rig, BlendshapeRig)
    weights = as_tensor("weights", weights, "(N,)").detach().cpu().double()
    sculpt = as_tensor("sculpt", sculpt, "(V,3)").detach().cpu().double()
    for what, given, expected in (("weights", weights, rig.deltas[:, 0, 0]), ("sculpt", sculpt, rig.vertices)):
        if given.shape != expected.shape:
            raise ShapeError(f"{what}: found {tuple(given.shape)}, expected {tuple(expected.shape)}")
    rows = weights.nonzero()[:, 0].tolist()
    pose = " ".join(f"{rig.names[row]}={float(weights[row]):.4g}" for row in rows)
    if not rows or not bool(((weights >= 0) & (weights <= 1)).all()):
        raise ValueRangeError(f"pose: found {pose or 'no weight'}, expected weights above 0 and at most 1")
    peak = float(f"{float(weights[rows[0]]):.6g}") if len(rows) == 1 else None  # as it was given
    if peak == 1:
        raise ValueRangeError(
            f"pose: found {pose} alone, which is the shape itself; expected two shapes, or a weight below 1"
        )
    drivers = tuple(rig.names[row] for row in rows)
    old = () if rig.correctives is None else rig.correctives.definitions
    acts = [set(one.drivers) == set(drivers) and abs((one.peak or 0.0) - (peak or 0.0)) < _SAME_PEAK for one in old]
    place = [*acts, True].index(True)
    if place < len(old):
        if not replace:
            raise NameMismatchError(
                f"corrective: found {old[place].name!r}, which acts at {pose} already; expected none: --replace "
                "(replace=True) puts the sculpt in its place"
            )
        name, drivers, peak = name or old[place].name, old[place].drivers, old[place].peak
    title = name or "_".join(drivers) + ("" if peak is None else f"_{100 * peak:.3g}")
    definition = Corrective(title, drivers, peak)
    definitions = (*old[:place], definition, *old[place + 1 :])
    neutral = rig.neutral.to("cpu").with_vertices(rig.vertices.detach().cpu().double())
    deltas = sculpt.new_zeros(len(definitions), *neutral.vertices.shape)
    if rig.correctives is not None:
        deltas[: len(old)] = rig.correctives.deltas.detach().cpu()
    before = BlendshapeRig(neutral, rig.deltas.detach().cpu(), rig.names, rig.correctives)(weights[None])[0]
    change = sculpt - before
    if float(change.norm(dim=-1).max()) < _CHANGED:
        raise ValueRangeError(f"sculpt: found the face that the rig shows at {pose}, expected a change of it")
    deltas[place] = 0.0
    bare = BlendshapeRig(neutral, rig.deltas.detach().cpu(), rig.names, Correctives(deltas, definitions))
    assert bare.activation is not None
    activation = float(bare.activation(weights[None])[0, place])
    deltas[place] = (sculpt - bare(weights[None])[0]) / activation
    made = Correctives(deltas.to(rig.deltas), definitions)
    more = () if peak is not None else tuple(one.name for one in old if set(one.drivers) > set(drivers))
    return SculptedCorrective(
        BlendshapeRig(rig.neutral, rig.deltas, rig.names, made), definition, activation, change, more
    )


def _motion_of_the_whole(shown: Tensor, sculpt: Tensor) -> Similarity | None:
    r"""The similarity (B = 1) that removes a motion of the whole mesh from a sculpt, if most vertices show one.

    .. math:: \min_{s,R,t} \sum_v \lVert s R y_v + t - x_v \rVert

    over the sculpt's vertices y and the rig's x, by reweighted least squares (Weiszfeld 1937): the vertices that the
    artist changed, less than half, do not count.
    """
    x, y = shown[None].double(), sculpt[None].double()
    before = (x - y).norm(dim=-1)
    if float(before.median()) < _SHIFTED:
        return None
    weights, similarity = torch.ones_like(before), similarity_transform(y, x)
    for _ in range(_ITERATIONS):  # each needs the distances of the one before
        weights = 1 / (similarity.apply(y) - x).norm(dim=-1).clamp(min=_CHANGED)
        similarity = similarity_transform(y, x, weights)
    left = float((similarity.apply(y) - x).norm(dim=-1).median())
    return similarity if left < _EXPLAINED * float(before.median()) else None


def checked_sculpt(path: object, sculpt: Mesh, rig: BlendshapeRig, shown: Tensor, align: str | None) -> Tensor:
    """The vertices of a sculpt (V,3) in place.

    Args:
        path: of the sculpt, for messages.
        rig: of V vertices.
        shown: what the rig shows at the pose, (V,3).
        align: ``"remove"`` a motion of the whole mesh, ``"keep"`` it as part of the sculpt, or refuse it if absent.
    """
    ours = rig.neutral
    if len(sculpt.vertices) != len(ours.vertices):
        raise TopologyError(
            f"{path}: found {len(sculpt.vertices):,} vertices, expected the rig's {len(ours.vertices):,}"
        )
    both = ours.polygons is not None and sculpt.polygons is not None
    found, expected = (_rows(mesh.polygons if both else mesh.faces) for mesh in (sculpt, ours))
    if lost := len(expected - found):
        raise TopologyError(
            f"{path}: found other vertices at {lost:,} of the rig's {len(expected):,} faces; expected the rig's "
            "topology and its order of vertices (export it, sculpt, and export again without reordering)"
        )
    size = extent(shown)
    check_unit(str(path), sculpt.vertices, size, "the rig", 0.5, 2.0)
    motion = _motion_of_the_whole(shown, sculpt.vertices)
    placed = sculpt.vertices if motion is None else motion.apply(sculpt.vertices.double())[0]
    far = float((placed - shown.to(placed)).norm(dim=-1).median())
    if far > _FAR * size:
        raise TopologyError(
            f"{path}: found half of the vertices {far:.3g} mm and more from where the rig shows them, expected a "
            "sculpt of this rig in its order of vertices"
        )
    if motion is None or align is not None:
        return sculpt.vertices if align == "keep" else placed
    undone = motion.inverse()
    trace = float(undone.rotation[0].diagonal().sum())
    angle = torch.rad2deg(torch.acos(torch.tensor((trace - 1) / 2).clamp(-1, 1)))
    shift = (undone.apply(shown.double())[0] - shown).mean(0).norm()
    raise AlignmentError(
        f"{path}: found the whole mesh moved by {float(shift):.3g} mm, turned by {float(angle):.2g} degrees and scaled "
        f"by {float(undone.scale):.5g} beside what is sculpted, expected it where the rig is; --align remove takes "
        "that out, --align keep takes it as part of the sculpt"
    )


def _rows(faces: Tensor | None) -> set[tuple[int, ...]]:
    assert faces is not None
    return {tuple(vertex for vertex in row if vertex >= 0) for row in faces.sort(1).values.tolist()}

"""Whether a head is a template's at rest: not in an expression, not squeezed, not lying."""

import torch
from torch import Tensor

from torchface.errors import TopologyError
from torchface.geometry.meshes.operators import edges
from torchface.geometry.meshes.unit_check import extent
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh
from torchface.number_checks import checked_type
from torchface.optim.box_qp import box_qp
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, recognised_mapping

# A shape is in a head where its weight, its share of how the head differs from the template where the shape acts, and
# its way exceed these together: none in 182 heads at rest (drawn for the performer, ICT's modes, registered scans,
# characters); of all shapes at full strength 80 to 85 %, of blinks, smiles, puckers, brows and open jaws 96 to 100 %.
_WEIGHT, _SHARE, _WAY = 0.2, 0.35, 4.0  # the way in millimetres at the template's size
_RIDGE, _EXACT_RIDGE = 0.1, 1e-6  # of H's diagonal: jawLeft and jawRight together explain what no face shows
_SEEN = 0.15  # of the weight given: less is nothing; shapes that are there are found by 0.3 of it and more
_OWN_HEAD = 0.01  # of the squared difference is left where the head is the template's own
_SQUEEZED, _AFFINE_SHARE = 1.3, 0.7  # of heads at rest 1.21 and 0.67 at most
_TURNED = 30.0  # degrees; heads at rest 11 at most
_SHORTEST = 1e-3  # of the template's extent: shorter edges count as so long
# Of the vertices: a shape that moves more of them by a tenth of its way is another head, such as a wider one, and no
# expression. Those of three rigs move 47 % of a face at most, a wider or thinner head 86 %.
_WHOLE = 0.65
_NAMED = 4


def neutral_notes(template: BlendshapeRig, head: Mesh) -> tuple[str, ...]:
    """What makes it likely that a head is not a template's at rest, a sentence each; none for a head at rest.

    Of a template with shapes that mean some of ARKit's the others are no expressions, such as a wider nose.

    Args:
        template: N shapes, V vertices, millimetres.
        head: of the template's topology, in any place and size.

    Raises:
        TopologyError: another number of vertices.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> neutral_notes(actor, actor.neutral.with_vertices(1.1 * actor.vertices))
        ()
    """
    meshes = checked_type("template", template, BlendshapeRig).neutral, checked_type("head", head, Mesh)
    rest, goal = (mesh.vertices.detach().cpu().double() for mesh in meshes)
    if rest.shape != goal.shape:
        raise TopologyError(f"head: found {len(goal)} vertices, expected the template's {len(rest)}")
    used = template.neutral.faces.cpu().unique()
    own, found = rest[used], goal[used]
    similarity = similarity_transform(own[None], found[None])
    placed = similarity.inverse().apply(goal[None])[0]
    notes = []
    angle = float(((similarity.rotation[0].trace() - 1) / 2).clamp(-1, 1).acos().rad2deg())
    if angle > _TURNED:
        notes.append(f"the neutral is turned by {angle:.0f}° beside the template, and the rig with it; is y up in it?")
    affine, explained = _affine(own, placed[used])
    _, sizes, axes = torch.linalg.svd(affine)
    if float(sizes[0] / sizes[2]) > _SQUEEZED and explained > _AFFINE_SHARE:
        wide, high, deep = (axes.T @ (sizes / sizes[1]).diag() @ axes).diagonal().tolist()
        notes.append(
            f"the neutral is {wide:.2f} times as wide, {high:.2f} as high and {deep:.2f} as deep as the template; "
            f"people differ by up to 1.2: was it scaled unevenly?"
        )
        placed = (placed - placed[used].mean(0)) @ torch.linalg.inv(affine).T + own.mean(0)
    return (*notes, *(_expression_notes(template, rest, placed) if template.names else ()))


def _affine(rest: Tensor, goal: Tensor) -> tuple[Tensor, float]:
    """The affine map (3,3) from points to points, about their means, and how much it explains of how they differ."""
    source, target = rest - rest.mean(0), goal - goal.mean(0)
    affine = torch.linalg.lstsq(source, target).solution.T
    left, before = ((points - target).square().sum() for points in (source @ affine.T, source))
    return affine, float(1 - left / before.clamp(min=1e-12))


def pose_notes(template: BlendshapeRig, head: Mesh, shown: Tensor) -> tuple[str, ...]:
    """A sentence where a head of the template's topology shows little or nothing of the weights (N,) that it is said to
    show."""
    if not bool(shown.any()):
        return ()
    rest, goal = (mesh.vertices.detach().cpu().double() for mesh in (template.neutral, head))
    used = template.neutral.faces.cpu().unique()
    fit = _EdgeFit(template, rest, similarity_transform(goal[None, used], rest[None, used]).apply(goal[None])[0])
    found, given = fit.weights(_RIDGE), shown.detach().cpu().double()
    missing = ((given * fit.way > _WAY) & (found < _SEEN * given)).nonzero()[:, 0].tolist()
    named = " ".join(f"{template.names[i]}={float(given[i]):g}" for i in missing[:_NAMED])
    return (f"the head shows nothing of {named}, and its neutral is wrong there; leave it out of --pose",) * bool(named)


class _EdgeFit:
    r"""How a template's shapes explain a head (V,3) in the template's place.

    .. math:: \min_{0 \le w \le 1} \sum_e \tfrac{1}{l_e} \lVert \Delta_e(y - x) - \sum_i w_i \Delta_e d_i \rVert^2

    over the edges e of length l, with a ridge. Faces of people differ smoothly, so their edges differ little.
    """

    def __init__(self, template: BlendshapeRig, rest: Tensor, goal: Tensor) -> None:
        deltas = template.deltas.detach().cpu().double()
        ends = edges(template.neutral.faces.cpu())
        ends = ends[deltas.any(-1).any(0)[ends].any(1)]  # others say nothing, and cost memory
        root = rest[ends].diff(dim=1)[:, 0].norm(dim=-1).clamp(min=_SHORTEST * extent(rest)).sqrt()[:, None]
        shapes = deltas.index_select(1, ends[:, 1]).sub_(deltas.index_select(1, ends[:, 0])).div_(root)
        acts = shapes.any(-1).any(0)
        self.shapes, self.off = shapes[:, acts], ((goal - rest)[ends].diff(dim=1)[:, 0] / root)[acts]
        self.way = deltas.norm(dim=-1).amax(1)
        flat = self.shapes.flatten(1)
        self._H, self._f = flat @ flat.T, -(flat @ self.off.flatten())

    def weights(self, ridge: float) -> Tensor:
        return box_qp(self._H + (ridge * self._H.diagonal()).diag(), self._f[None])[0]

    def left(self, weights: Tensor) -> Tensor:
        """What the weights leave of each edge's squared difference."""
        return (self.off - torch.tensordot(weights, self.shapes, 1)).square().sum(-1)


def _expression_notes(template: BlendshapeRig, rest: Tensor, goal: Tensor) -> list[str]:
    """Which of a template's shapes are in a head (V,3) in the template's place."""
    fit = _EdgeFit(template, rest, goal)
    found, way, energy = fit.weights(_RIDGE), fit.way, fit.shapes.square().sum(-1)
    where = energy / energy.amax(1, keepdim=True).clamp(min=1e-12)
    signal = found.square() * (energy * where).sum(1)
    share = signal / (signal + where @ fit.left(found)).clamp(min=1e-12)
    there = (found > _WEIGHT) & (share > _SHARE) & (found * way > _WAY)
    motion = template.deltas.detach().cpu().norm(dim=-1)
    there &= (motion > 0.1 * motion.amax(1, keepdim=True)).double().mean(1) < _WHOLE
    expressions = recognised_mapping(template.names, ARKIT).any(0)
    if bool(expressions.any()):
        there &= expressions
    if not bool(there.any()):
        return []
    exact = fit.weights(_EXACT_RIDGE)
    own = float(fit.left(exact).sum() / fit.off.square().sum()) < _OWN_HEAD
    values = exact if own else found
    order = [i for i in (values * way).argsort(descending=True).tolist() if there[i]][:_NAMED]
    named = " ".join(f"{template.names[i]}={float(values[i]):.1f}" for i in order)
    if own:
        return [f"the neutral is the template's own head in an expression; torchface rig --pose {named} takes it out"]
    return [
        f"the neutral is likely not at rest: it differs from the template as {named} does, by up to "
        f"{float(found[order[0]] * way[order[0]]):.0f} mm ({100 * float(share[order[0]]):.0f} % of how it differs "
        f"there); torchface rig --pose {named} takes it out"
    ]

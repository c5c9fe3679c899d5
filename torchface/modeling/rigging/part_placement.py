"""The parts inside a head put where they belong in a new one: eyeballs behind its lids, teeth behind its lips."""

from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import components, triangle_normals
from torchface.geometry.meshes.vertex_graph import VertexGraph
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh
from torchface.modeling.rigging.part_clearance import Clearance
from torchface.modeling.rigging.penetration import InnerParts, inner_parts
from torchface.part_materials import EYEBALL, part_material
from torchface.registration import Registration, hidden_parts, with_template_skin
from torchface.registration.scan_colors import own_colors
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

_THIN, _THICKER, _MIN_VERTICES = 0.05, 4.0, 20
_MAX_ITERATIONS = 8
_MAX_TOTAL_WEIGHT = 20.0  # of a registered skin, whose errors are neighbours' too
# How far people's eyeballs are from where the skin around carries a template's: across, up and to the front.
_TRANSLATION_DEVIATION = (0.5, 0.8, 1.0)
_LIP_DEVIATION = 0.03  # of teeth in height, which an open mouth shows
_MOUTH, _LIPS = (
    48,
    [62, 66],
)  # of iBUG's landmarks: the first of the mouth, the middles of the upper lip's edge and lower
_PARTED = 3.5  # millimetres between them from which a mouth is open
_SCALE_DEVIATION = 0.03
_FACING = 0.6
_OUTLIER = 2.0
_HOSTS = 8
_MAX_RISE, _MAX_DROP = 1.0, 0.2
_NOTHING = 1e-3
_BEHIND_SKIN, _SPREAD = 0.5, 8  # millimetres, rings of vertices
_WHITES, _DARKEST = 0.95, 0.75  # which quantile of an eye's colours is white; of whites and teeth beside the template's
_TOUCHING, _AJAR = 0.2, 0.7  # millimetres between lips that are shut: in a template, after its registration


def place_parts(template: BlendshapeRig, neutral: Mesh, parts: InnerParts) -> Mesh:
    r"""A head at rest with the template's parts fitted into it, whatever places they had.

    Hard parts of a group move together by a similarity, so that eyeballs stay round and teeth keep their form: the
    head's, moved with the skin around them, then the translation :math:`\tau` and the growth :math:`\sigma` that
    give the skin before each vertex p the thickness :math:`t_p` that it has in the template, from the group's middle
    outward,

    .. math:: \min_{\tau,\sigma} \sum_p w_p (t'_p(\tau,\sigma) - t_p)^2
        + \tau^T \Lambda \tau + \lambda_\sigma \sigma^2

    with the deviations that people show: lids that a registration has a millimetre off would else turn eyes inward.
    Under the upper lip of iBUG's landmarks teeth show as much as in the template: people's lips are longer or shorter
    than their heads' sizes say.

    Shells and lashes follow the nearest skin; shells keep the height over the eyeball that they have in the template.
    What is left of parts before the skin is cleared as in ``clear_parts``.

    Args:
        template: the rig whose neutral has every part in place.
        neutral: a head of the same topology, millimetres, oriented as the template is; a registered scan shows none of
            its parts.
        parts: of the template; see ``inner_parts``.

    Returns:
        The head with other places for what is not its largest connected part, and for skin that parts came through.

    Example:
        >>> from torchface.modeling import inner_parts
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> parts = inner_parts(actor)
        >>> moved = actor.vertices.clone()
        >>> moved[parts.vertices, 2] -= 5.0  # a registration that left eyes and teeth behind
        >>> placed = place_parts(actor, actor.neutral.with_vertices(moved), parts)
        >>> bool((placed.vertices - actor.vertices).norm(dim=1).median() < 0.5)  # millimetres
        True
    """
    rest = template.vertices.detach().cpu().double()
    found = neutral.vertices.detach().cpu().double()
    body = (parts.label == parts.body).nonzero()[:, 0]
    whole = similarity_transform(rest[None, body], found[None, body])
    aligned = whole.apply(rest[None])[0]
    placed = _following(aligned, found, parts, body)
    for group in parts.group.unique().tolist():  # one mouth, two eyes
        own = parts.group == group
        bones = parts.vertices[own & parts.hard]
        if len(bones) == 0:
            continue
        fitted = _fitted(aligned, found, bones, parts, _lips_before(template.neutral, aligned, bones))
        placed[bones] = fitted.apply(aligned[None, bones])[0]
        shells = parts.vertices[own & ~parts.hard]
        middle = placed[bones].mean(0)
        height = fitted.scale[0] * (aligned[shells] - aligned[bones].mean(0)).norm(dim=-1)
        outward = placed[shells] - middle
        kept = outward.norm(dim=-1).clamp(height - _MAX_DROP, height + _MAX_RISE)
        placed[shells] = middle + torch.nn.functional.normalize(outward, dim=-1) * kept[:, None]
    placed = placed + Clearance(placed, parts).step(placed, closing=False)
    if float((placed - found).abs().max()) < _NOTHING:
        return neutral
    return neutral.with_vertices(placed.to(neutral.vertices))


def with_placed_parts(rig: BlendshapeRig, registration: Registration) -> Registration:
    """A registration whose eyeballs and teeth are where ``place_parts`` has them, and round, in place of bent ones,
    whose lips meet and mouth lies behind the skin, and whose hidden parts have the template's colours, eyes and teeth
    in the scan's light."""
    template, parts = rig.neutral, inner_parts(rig)
    upright = registration.pose.inverse().apply(registration.mesh.vertices.detach().cpu().double())[0]
    bent = template.with_vertices(upright.to(template.vertices))
    met = with_met_lips(bent, template)
    placed = with_mouth_behind_skin(place_parts(rig, met, parts) if len(parts.vertices) else met)
    mesh = registration.mesh
    if placed is not bent:
        vertices = registration.pose.apply(placed.vertices.detach().cpu().double())[0]
        mesh = mesh.with_vertices(vertices.to(mesh.vertices))
    hidden, inner = hidden_parts(template, registration.matched), torch.zeros(len(template.vertices), dtype=torch.bool)
    inner[parts.vertices] = True
    light = _scan_light(registration, template).to(template.vertices)
    shaded = replace(
        template,
        colors=None if template.colors is None else (light * template.colors).clamp(0, 1),
        texture=None if template.texture is None else (light[:, None, None] * template.texture[:3]).clamp(0, 1),
    )
    mesh = with_template_skin(with_template_skin(mesh, template, hidden & ~inner), shaded, hidden & inner)
    return replace(registration, mesh=mesh)


def _scan_light(registration: Registration, template: Mesh) -> Tensor:
    """The whites of eyes that a scan shows beside the template's, (3,), at most as bright: scans are often dim, and
    what they do not show of a head would glow beside their skin. Lids shade whites, and skin beside them tints them:
    they are not far darker, no darker than skin, and have a third of the hue."""
    found, own, matched = registration.mesh.colors, own_colors(template), registration.matched.cpu()
    balls = [mask.cpu() & matched for name, mask in template.regions.items() if part_material(name) is EYEBALL]
    eyes = torch.stack(balls).any(0) if balls else matched & False
    if found is None or own is None or int(eyes.sum()) < _MIN_VERTICES:
        return torch.ones(3)
    found = found.cpu()
    seen, usual = (colors[eyes].quantile(_WHITES, dim=0) for colors in (found, own))
    light, skin = (seen / usual).clamp(min=0.1), found[matched & ~eyes].median(0).values.mean() / usual.mean()
    return torch.maximum(light.mean(), skin).clamp(_DARKEST, 1) * (light / light.mean()) ** (1 / 3)


def with_met_lips(head: Mesh, template: Mesh) -> Mesh:
    """A head with no slit between lips that touch in its template, where a registration left them ajar."""
    pairs = None if template.annotations is None else template.annotations.contacts
    if pairs is None:
        return head
    first, second = ((mesh.vertices[pairs[:, 0]] - mesh.vertices[pairs[:, 1]]).norm(dim=1) for mesh in (template, head))
    met = pairs[(first < _TOUCHING) & (second < _AJAR)]
    vertices = head.vertices.clone()
    vertices[met] = vertices[met].mean(1, keepdim=True)
    return head.with_vertices(vertices)


def with_mouth_behind_skin(head: Mesh) -> Mesh:
    """An upright head whose ``mouth_interior``, where it has come through lip or chin, lies behind the skin again;
    its rim stays."""
    regions = head.regions
    if "mouth_interior" not in regions:
        return head
    bag, faces = regions["mouth_interior"].cpu(), head.faces.cpu()
    vertices = head.vertices.detach().cpu().double()
    rows = bag.nonzero()[:, 0]
    front = vertices[rows].clone()
    front[:, 2] = vertices[:, 2].amax() + 1
    back = front.new_tensor([0.0, 0.0, -1.0]).expand_as(front)
    label = components(faces, len(vertices))
    skin = faces[(label == label[rows].mode().values)[faces].all(1) & ~bag[faces].any(1)]
    hits = RayCaster(vertices, skin).cast(front, back)
    # Between parted lips a ray meets the head's back from inside.
    met = (hits.triangle >= 0) & (triangle_normals(vertices, skin)[hits.triangle.clamp(min=0), 2] > 0)
    depth = torch.where(met, front[:, 2] - hits.distance - _BEHIND_SKIN, torch.inf)
    moved = torch.zeros(len(vertices), 1, dtype=torch.float64)
    least = (depth - vertices[rows, 2]).clamp(max=0)[:, None]
    if not bool((least < -_BEHIND_SKIN).any()):
        return head
    graph = VertexGraph(faces, len(vertices))
    for _ in range(_SPREAD):  # rings of neighbours
        moved[rows] = torch.minimum(least, (graph.sum(moved) / graph.degree[:, None])[rows])
    vertices[:, 2:] += moved
    return head.with_vertices(vertices.to(head.vertices))


def _following(aligned: Tensor, found: Tensor, parts: InnerParts, body: Tensor) -> Tensor:
    """Every part carried along by the body's nearest vertices."""
    placed = found.clone()
    rest = (parts.label != parts.body).nonzero()[:, 0]
    if len(rest) == 0:
        return placed
    distance, nearest = cKDTree(aligned[body].numpy()).query(aligned[rest].numpy(), k=min(_HOSTS, len(body)))
    distances = torch.from_numpy(distance).view(len(rest), -1)
    hosts = body[torch.from_numpy(nearest).view(len(rest), -1)]
    weights = 1 / (distances + 0.1 * distances.amax(1, keepdim=True) + 1e-6) ** 2
    weights = weights / weights.sum(1, keepdim=True)
    placed[rest] = aligned[rest] + ((found - aligned)[hosts] * weights[..., None]).sum(1)
    return placed


def _lips_before(template: Mesh, aligned: Tensor, bones: Tensor) -> Tensor | None:
    """The vertices of the lips' edges, upper and lower, (2,), if bones lie nearest to the mouth of all landmarks."""
    marks = None if template.annotations is None else template.annotations.landmarks
    if marks is None or len(marks) != 68:
        return None
    marks = marks.cpu()
    beside = cKDTree(aligned[bones].numpy()).query(aligned[marks].numpy())[0].argmin()
    return marks[_LIPS] if beside >= _MOUTH else None


def _fitted(aligned: Tensor, found: Tensor, bones: Tensor, parts: InnerParts, lips: Tensor | None) -> Similarity:
    """The similarity that takes a group's hard parts from where the template aligned with the head has them."""
    middle = aligned[bones].mean(0)
    wanted = _SkinBefore.of(aligned, parts.skin, middle, aligned[bones])
    thin = wanted.thickness[wanted.met].clamp(min=0)
    use = wanted.met & (wanted.thickness < (float(thin.quantile(_THIN)) if len(thin) else 0.0) + _THICKER)
    around = parts.skin[wanted.triangle[use]].unique()
    across, up, front = _TRANSLATION_DEVIATION
    if len(around) < _MIN_VERTICES:
        around = parts.skin.unique()
    moved = found - aligned
    shift = moved[around].mean(0)
    if lips is not None:
        skin, (lip, lower) = shift[1], moved[lips]
        shift, up = lip.clone(), _LIP_DEVIATION
        if float(lip[1] - lower[1]) > _PARTED:  # a raised lip is not short, and a jaw that drops takes no upper teeth
            shift[1] = torch.stack([lip[1], skin, torch.zeros_like(skin)]).median()
    # Lids show little of an eyeball's size and nothing of its rotation: both are the whole head's.
    centre = middle + shift
    offsets = aligned[bones[use]] - middle
    state = torch.zeros(4, dtype=torch.float64)
    prior = 1 / torch.tensor([across, up, front, _SCALE_DEVIATION], dtype=torch.float64).square()
    for _ in range(_MAX_ITERATIONS if bool(use.any()) else 0):
        now = centre + state[:3] + (1 + state[3]) * offsets
        have = _SkinBefore.of(found, parts.skin, centre + state[:3], now)
        error = torch.where(have.met, have.thickness - wanted.thickness[use], 0.0)
        weight = have.met / (1 + (error / _OUTLIER) ** 2)
        weight = weight * (_MAX_TOTAL_WEIGHT / max(float(weight.sum()), _MAX_TOTAL_WEIGHT))
        rows = torch.cat([have.across, offsets.norm(dim=-1)[:, None]], dim=1)
        system = rows.T @ (weight[:, None] * rows) + prior.diag()
        state = state + torch.linalg.solve(system, rows.T @ (weight * error) - prior * state)
    scale = 1 + state[3:]
    rotation = torch.eye(3, dtype=torch.float64)[None]
    return Similarity(scale, rotation, (centre + state[:3] - scale * middle)[None])


@dataclass(frozen=True, eq=False)
class _SkinBefore:
    """The skin before points (n,3), seen from a middle."""

    met: Tensor  # whether there is any, and faces the same way, (n,) bool
    thickness: Tensor  # how far it lies before each point, (n,), negative behind
    triangle: Tensor  # which, (n,) int64
    across: Tensor  # how much thinner it gets as the middle and the point move, (n,3)

    @staticmethod
    def of(vertices: Tensor, skin: Tensor, middle: Tensor, points: Tensor) -> "_SkinBefore":
        far = (points - middle).norm(dim=-1)
        ways = (points - middle) / far.clamp(min=1e-9)[:, None]
        hits = RayCaster(vertices, skin).cast(middle.expand_as(points), ways)
        normals = triangle_normals(vertices, skin)[hits.triangle]
        facing = (normals * ways).sum(-1)
        met = (hits.triangle >= 0) & (facing > _FACING)
        thickness = torch.where(met, hits.distance - far, 0.0)
        return _SkinBefore(met, thickness, hits.triangle, normals / facing.clamp(min=_FACING)[:, None])

"""The parts inside a head (teeth, gums, eyeballs, shells of the eye): how far they stand out of its skin, and which
are bone."""

from dataclasses import dataclass

import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import components, triangle_normals, vertex_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.similarity import similarity_transform
from torchface.mesh import Mesh
from torchface.number_checks import checked_type
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

TOLERANCE = 0.2
"""Millimetres; a vertex that stands out of the skin by less is not seen."""

_LIFT = 0.05
_RAYS = 24
_OPENING = 30.0
_OPEN_SKIN = 0.15
_HAIR = ("lash", "brow", "hair", "beard")
_BEFORE_THE_SKIN = 0.42
_TOUCHING = 2.0
_NEAR = 30.0
_RIGID = 0.1
_MOSTLY = 0.75
_FOLLOWS, _FOLLOWS_SHARE = 1.0, 0.3


@dataclass(frozen=True, eq=False)
class Standing:
    """Where parts stand to the skin in a pose."""

    depth: Tensor  # how far each vertex of a part stands out, (P,), millimetres; 0 where it does not
    outward: Tensor  # unit directions from the middle of its group through each vertex, (P,3)
    triangle: Tensor  # row of `InnerParts.skin` that each vertex has come through, (P,) int64; -1 where it has not
    way: Tensor  # how far along `outward` that triangle lies behind the vertex, (P,), millimetres


@dataclass(frozen=True, eq=False)
class InnerParts:
    """The parts that belong behind the skin, and the skin that hides them.

    Args:
        vertices: ids of the parts' vertices, (P,) int64.
        group: which pocket of the head each lies in (the mouth, an eye), (P,) int64 from 0.
        label: the connected part of every vertex of the mesh, (V,) int64.
        body: the connected part that carries the skin.
        skin: triangles near the parts that are open to the outside at rest, (S,3) int64.
        hard: which vertices are bone, such as teeth, gums and eyeballs, and not shells of the eye, (P,) bool.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> parts = inner_parts(actor)
        >>> parts.depth(actor.vertices.double()).max().item()  # nothing stands out of the skin at rest
        0.0
    """

    vertices: Tensor
    group: Tensor
    label: Tensor
    body: int
    skin: Tensor
    hard: Tensor

    def depth(self, vertices: Tensor) -> Tensor:
        """How far each vertex of a part stands out of the skin in a pose, (P,), millimetres; 0 where it does not.

        A vertex stands out when the straight line from the middle of its group through it leaves the skin before it
        gets there and meets no skin beyond: it has come through and is seen. What is seen through open lips or lids has
        no skin behind it, what a lip covers has skin before it; neither counts. The depth is the distance to the
        nearest point of the skin.

        Args:
            vertices: of the whole head in the pose, (V,3), millimetres.
        """
        return self.standing(vertices).depth

    def standing(self, vertices: Tensor) -> Standing:
        """``depth`` of vertices (V,3), with where each has come through."""
        vertices = vertices.detach().cpu().double()
        points = vertices[self.vertices]
        offsets = points - self.middles(vertices)[self.group]
        far = offsets.norm(dim=-1)
        outward = offsets / far.clamp(min=1e-9)[:, None]
        if len(points) == 0 or len(self.skin) == 0:
            none = torch.zeros(len(points), dtype=torch.float64)
            return Standing(none, outward, torch.full((len(points),), -1), none)
        caster = RayCaster(vertices, self.skin)
        # Few rays meet skin before the middle, and to ask how far they get is cheaper than to ask what they hit.
        rows = (caster.distances(points, -outward, float(far.max())) < far).nonzero()[:, 0]
        hits = caster.cast(points[rows], -outward[rows])
        entered = (triangle_normals(vertices, self.skin[hits.triangle]) * outward[rows]).sum(-1) > 0
        # A ray along an edge may meet it in one query and pass it in the next.
        before = hits.distance < far[rows]
        through = before & entered & ~caster.occluded(points[rows], outward[rows])
        way, triangle = torch.zeros_like(far), torch.full((len(points),), -1)
        way[rows[through]], triangle[rows[through]] = hits.distance[through], hits.triangle[through]
        # The way along the ray is never shorter than the nearest one.
        depth, deep = way.clone(), way > TOLERANCE / 2
        if deep.any():
            beside = _within(vertices, self.skin, points[deep], way[deep])
            depth[deep] = SurfaceIndex(vertices, beside).among_nearest_samples(points[deep], 12).distance
        return Standing(depth, outward, triangle, way)

    def middles(self, vertices: Tensor) -> Tensor:
        """The middle of each group in a pose (V,3), (G,3)."""
        count = int(self.group.max()) + 1 if len(self.group) else 0
        total = vertices.new_zeros(count, 3).index_add_(0, self.group, vertices[self.vertices])
        return total / self.group.bincount(minlength=count)[:, None]


def _within(vertices: Tensor, faces: Tensor, points: Tensor, reach: Tensor) -> Tensor:
    """The faces, and some others, of which a point lies within the reach (Q,) of one of the points (Q,3)."""
    corners = vertices[faces]
    centres = corners.mean(1)
    sizes = (corners - centres[:, None]).norm(dim=-1).amax(1)
    return faces[(torch.cdist(points, centres) <= reach[:, None] + sizes).any(0)]


def inner_parts(template: BlendshapeRig) -> InnerParts:
    """Finds the parts that lie inside a head at rest.

    Every connected part is one but the largest, which carries the skin, and those of regions of hair, such as lashes,
    which stand before the skin by nature, and groups of parts from which nearly half of all directions are free.

    Args:
        template: a rig, millimetres; its shapes show which parts are bone.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> parts = inner_parts(actor)
        >>> bool(parts.hard.any()), len(parts.vertices) < len(actor.vertices)  # eyeballs are bone
        (True, True)
    """
    mesh = checked_type("template", template, BlendshapeRig).neutral
    vertices, faces = mesh.vertices.detach().cpu().double(), mesh.faces.cpu()
    label = components(faces, len(vertices))
    body = int(label.bincount().argmax())
    used = torch.zeros(len(vertices), dtype=torch.bool)
    used[faces.flatten()] = True
    rest = ((label != body) & used & ~_hair(mesh)).nonzero()[:, 0]
    if len(rest) == 0:
        return InnerParts(rest, rest, label, body, faces[:0], rest > 0)
    skin = _open_skin(vertices, faces, label == body)
    if len(rest) and len(skin):
        distance = cKDTree(vertices[rest].numpy()).query(vertices.numpy(), distance_upper_bound=_NEAR)[0]
        skin = skin[torch.from_numpy(distance < _NEAR)[skin].any(1)]
    caster = RayCaster(vertices, faces[(label == body)[faces].all(1)])
    free = _share_free(caster, vertices[rest], _random_directions(_RAYS, len(rest)))
    group = _groups(vertices[rest], label[rest])
    mean = torch.zeros(int(group.max()) + 1, dtype=torch.float64).index_add_(0, group, free) / group.bincount()
    rest = rest[(mean < _BEFORE_THE_SKIN)[group]]
    group = _groups(vertices[rest], label[rest])
    return InnerParts(rest, group, label, body, skin, is_rigid(template, rest, group, label[rest]))


def shape_depths(rig: BlendshapeRig, parts: InnerParts) -> Tensor:
    """How far each vertex of a part stands out of the skin at rest and in every shape at weight 1, (N+1,P).

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> depths = shape_depths(actor.select(["jawOpen"]), inner_parts(actor))
        >>> len(depths), depths[0].max().item()  # at rest, then each shape
        (2, 0.0)
    """
    poses = torch.cat([torch.zeros_like(rig.deltas[:1]), rig.deltas.detach()])
    return torch.stack([parts.depth(rig.vertices + pose) for pose in poses])  # each pose is ray cast by itself


def _hair(mesh: Mesh) -> Tensor:
    mask = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    for name, region in mesh.regions.items():
        if any(word in name.lower() for word in _HAIR):
            mask |= region.cpu()
    return mask


def _open_skin(vertices: Tensor, faces: Tensor, body: Tensor) -> Tensor:
    """The body's triangles from which a good part of the outside is seen at rest, not the linings of its pockets."""
    normals = vertex_normals(vertices, faces)
    ids = (body & (normals.norm(dim=-1) > 0.5)).nonzero()[:, 0]
    about = torch.nn.functional.normalize(_random_directions(_RAYS, len(ids)) + normals[ids], dim=-1)
    free = _share_free(RayCaster(vertices, faces), vertices[ids] + _LIFT * normals[ids], about)
    seen = torch.zeros(len(vertices), dtype=torch.bool)
    seen[ids] = free > _OPEN_SKIN
    return faces[seen[faces].all(1)]


def _share_free(caster: RayCaster, points: Tensor, directions: Tensor) -> Tensor:
    """The share of the directions (R,Q,3) in which nothing stands before points (Q,3) within the opening, (Q,)."""
    starts = points.expand_as(directions).reshape(-1, 3)
    reach = caster.distances(starts, directions.reshape(-1, 3), _OPENING)
    return (reach.view(len(directions), -1) >= 0.999 * _OPENING).double().mean(0)


def _random_directions(rays: int, count: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(rays, count, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(drawn, dim=-1)


def _groups(points: Tensor, label: Tensor) -> Tensor:
    """Parts that nearly touch lie in one pocket: a number a vertex, (P,) int64, from 0."""
    if len(points) == 0:
        return label
    own = label.unique(return_inverse=True)[1].numpy()
    count = int(own.max()) + 1
    near = cKDTree(points.numpy()).query_pairs(_TOUCHING, output_type="ndarray")
    first, second = own[near].T
    _, group = connected_components(coo_array((first * 0 + 1, (first, second)), (count, count)), directed=False)
    return torch.from_numpy(group.astype("int64"))[own]


def is_rigid(template: BlendshapeRig, vertices: Tensor, group: Tensor, label: Tensor) -> Tensor:
    """Whether each vertex of the parts is hard, (P,) bool: of a part that moves rigidly, or goes along with such parts.

    A part goes along, as gums do with teeth, where its vertices move nearly as the nearest rigid ones, to a millimetre
    on average or three tenths of their own motion.

    Args:
        template: N shapes, V vertices.
        vertices: ids of the parts' vertices, (P,) int64.
        group: which pocket of the head each lies in, (P,) int64.
        label: the connected part of each, (P,) int64.
    """
    rest, deltas = template.vertices.detach().cpu().double(), template.deltas.detach().cpu().double()
    rigid = torch.zeros(len(vertices), dtype=torch.bool)
    for one in label.unique().tolist():  # a head has tens of parts of all sizes
        rows = label == one
        ids = vertices[rows]
        moving = deltas[:, ids]
        moving = moving[moving.abs().amax((1, 2)) > _RIGID]
        if len(moving) == 0:
            rigid[rows] = True
        elif len(ids) >= 3:
            bent = (rest[ids] + moving - rigidly_moved(rest[ids], rest[ids] + moving)).abs().amax((1, 2))
            rigid[rows] = float((bent < _RIGID).double().mean()) >= _MOSTLY
    hard = rigid.clone()
    for pocket in group.unique().tolist():  # one mouth, two eyes
        bones = vertices[rigid & (group == pocket)]
        if len(bones) == 0:
            continue
        tree = cKDTree(rest[bones].numpy())
        for one in label[~rigid & (group == pocket)].unique().tolist():
            rows = label == one
            ids = vertices[rows]
            beside = bones[torch.from_numpy(tree.query(rest[ids].numpy())[1])]
            apart = (deltas[:, ids] - deltas[:, beside]).norm(dim=-1).amax(0).mean()
            moved = deltas[:, ids].norm(dim=-1).amax(0).mean()
            hard[rows] = float(apart) < max(_FOLLOWS, _FOLLOWS_SHARE * float(moved))
    return hard


def rigidly_moved(rest: Tensor, poses: Tensor) -> Tensor:
    """The rigid motions of a part (n,3) that come nearest to its poses (N,n,3), as places (N,n,3)."""
    start = rest.expand_as(poses)
    return similarity_transform(start, poses, scale=False).apply(start)

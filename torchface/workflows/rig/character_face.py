"""The face of a character: found on its surface, and which of the character's pieces move with it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.geometry.meshes.operators import triangle_normals
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.meshes.uv_seams import split_at_seams
from torchface.io.gltf.character_scene import Block, Character
from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.landmarks.images.ibug_68 import COUNT
from torchface.landmarks.surfaces.eye_openings import Opening
from torchface.landmarks.surfaces.face_on_surface import (
    FaceOnSurface,
    FaceSearch,
    NoFaceOnSurfaceError,
    ReferencePoints,
)
from torchface.landmarks.surfaces.lip_line import lip_line
from torchface.mesh import Mesh
from torchface.modeling.rigging.eyelid_closure import EYES, SkinOfHead, eyes_seen
from torchface.modeling.rigging.joined_vertices import joined_vertices
from torchface.progress import Progress
from torchface.registration.scan_preparation import LEAST_TRIANGLES, Landmarks
from torchface.rendering.textured_surface import Material, TexturedSurface
from torchface.synthetic import neutral_head
from torchface.workflows.named_finders import load_finder

_HEAD_SHARE = 0.5  # of a vertex's weights on the head's bone, from which pictures frame it
_REACH, _BELOW, _NECK = 280.0, -210.0, 60.0  # millimetres of the reference: from its middle, below its eyes
_EYE_REACH, _MOUTH_REACH, _SKIN_REACH = 48.0, 140.0, 8.0  # a muzzle is long
_BEFORE_LIPS, _MOUTH_HEIGHT = 4.0, 38.0
_FACE_REACH, _BEARD_REACH = 95.0, 130.0
_TUFT, _ROOTED = 40.0, 3.0  # millimetres: the size of a tuft of a beard, and how near to the skin it begins
_STILL = re.compile(
    r"(?<!brow)(?<!brow[_ .])hair|(?<![a-z])(hat|cap)(?![a-z])|helmet|glass|cloth|outfit|shirt|collar|scarf|hood"
    r"|(?<![a-z])mask|earring|(?<![a-z])horns?(?![a-z])",
    re.IGNORECASE,
)
"""Names of what does not move with a face, wherever it lies."""
_FACIAL = re.compile(r"beard|mou?stache|goatee|whisker|stubble|sideburn|eyebrow|eyelash", re.IGNORECASE)
"""Names of what moves with a face however far it reaches."""
SKIN = (0.8, 0.65, 0.56, 1.0)
_LEAST_ASTRAY, _ASTRAY = 15.0, 4.0  # millimetres, and times the median, that a point may lie from a head's
_SHARES = torch.linspace(0.04, 0.96, 17, dtype=torch.float64)
_LIPS = slice(48, 68)


@dataclass(frozen=True, eq=False)
class CharacterFace:
    """A character's head in the reference's place and size."""

    found: FaceOnSurface  # the face on the character's surface
    vertices: Tensor  # all of the character's, (V,3) float64, millimetres of the reference
    rows: Tensor  # the character's vertices in `head`, (K,)
    head: Mesh  # the pieces that move with the face
    skin: Mesh  # what the template is registered to
    skin_rows: Tensor  # the character's vertices in `skin`, (S,)
    movable: Tensor  # which of the head's vertices may move, (K,) bool: not those at the cut through the neck
    landmarks: Landmarks  # template vertices and where they lie, as `register` takes them

    def on(self, character: Character) -> "CharacterFace":
        """The same face on a character that has got more vertices."""
        reference, search = character_search()
        return face_pieces(character, self.found, reference, search.reference)


def textured(character: Character) -> TexturedSurface:
    """A character's surface, to draw it."""
    materials = tuple(
        Material(color, texture) for color, texture in zip(character.colors, character.textures, strict=True)
    )
    return TexturedSurface(character.vertices, character.faces, character.uvs, character.material, materials)


def find_character_face(
    character: Character, surface: TexturedSurface, progress: Progress | None = None
) -> CharacterFace:
    """The face of a character, in any unit and pose, which the surface shows."""
    reference, search = character_search()
    framed = None if character.head is None else character.head > _HEAD_SHARE
    found = search.find(surface, framed, progress)
    return face_pieces(character, found, reference, search.reference)


def character_search() -> tuple[Mesh, FaceSearch]:
    """The embedded performer's mean head, and what finds faces on surfaces by it."""
    reference, finder = neutral_head(texture=False), load_finder()
    points = ReferencePoints(reference.vertices[reference.landmarks], finder.places, _reference_surface)
    return reference, FaceSearch(shipped_detector(), finder.finder, points)


@lru_cache(2)
def _reference_surface(painted: bool) -> TexturedSurface:
    return mesh_surface(neutral_head(texture=painted))


def mesh_surface(mesh: Mesh) -> TexturedSurface:
    """A mesh's surface with its texture, or of plain skin; its vertices are split at the texture's seams."""
    if mesh.texture is None or mesh.uvs is None:
        return plain_surface(mesh.vertices.double(), mesh.faces, SKIN)
    corners = None if mesh.uv_faces is None else mesh.uv_faces.numpy()
    split = split_at_seams(len(mesh.vertices), mesh.faces.numpy(), corners)
    uvs = mesh.uvs if split.uv_of is None else mesh.uvs[torch.from_numpy(split.uv_of)]
    opaque = torch.cat([mesh.texture[:3].float(), torch.ones_like(mesh.texture[:1], dtype=torch.float32)])
    return replace(
        plain_surface(mesh.vertices.double()[torch.from_numpy(split.vertex_of)], torch.from_numpy(split.triangles)),
        uvs=uvs,
        materials=(Material(torch.ones(4), opaque),),
    )


def face_pieces(character: Character, found: FaceOnSurface, reference: Mesh, points: ReferencePoints) -> CharacterFace:
    """The head's pieces, by where they lie: what the points lie on is skin, the rest eyes, teeth, lashes or still."""
    vertices = found.pose.inverse().apply(character.vertices)[0]
    eyes = points.landmarks[36:48].double().mean(0)
    middle = eyes + torch.tensor([0.0, 0.0, -_NECK], dtype=torch.float64)
    near = ((vertices - middle).norm(dim=-1) < _REACH) & (vertices[:, 1] > eyes[1] + _BELOW)
    faces = character.faces[near[character.faces].all(1)]
    joined = joined_vertices(vertices, faces)
    part = joined.part[joined.of]
    placed = found.pose.inverse().apply(found.points)[0]
    skin_part, on_skin, toward = find_skin(vertices, faces, part, placed)
    if toward < 0:  # the file's normals look inward
        faces = faces.flip(1)
    allowed = torch.zeros(int(part.max()) + 1, dtype=torch.bool)
    skin_faces = faces[part[faces[:, 0]] == skin_part]
    if len(skin_faces) < LEAST_TRIANGLES:
        raise NoFaceOnSurfaceError(
            f"found no face: what looks like one lies on a piece of {len(skin_faces)} triangles, expected a head's "
            f"surface of at least {LEAST_TRIANGLES}",
            found.views,
        )
    skin_tree = cKDTree(vertices[skin_faces.unique()].numpy())
    still = torch.tensor([_is_called(block, _STILL) for block in character.blocks])
    facials = torch.tensor([_is_called(block, _FACIAL) for block in character.blocks]) & ~still
    for one in part[faces[:, 0]].unique().tolist():  # a head has tens of parts
        rows = (part == one).nonzero()[:, 0]
        own = vertices[rows]
        name_moves = not bool(still[character.block[rows[0]]])
        facial = bool(facials[character.block[rows[0]]])
        allowed[one] = one == skin_part or facial or (name_moves and _moves(own, placed, skin_tree))
    kept = faces[allowed[part[faces[:, 0]]]]
    rows, local = kept.unique(return_inverse=True)
    cut = torch.zeros(len(vertices), dtype=torch.bool)
    cut[character.faces[~near[character.faces].all(1)].flatten()] = True
    cut_joined = torch.zeros(len(joined.vertices), dtype=torch.bool)
    cut_joined[joined.of[cut]] = True
    skin_rows, skin_local = skin_faces.unique(return_inverse=True)
    upright = SkinOfHead(vertices, faces, part != skin_part, part)
    landmarks = with_edges(_landmarks(reference, points, placed, on_skin), reference, upright, placed)
    return CharacterFace(
        found,
        vertices,
        rows,
        Mesh(vertices[rows].float(), local.reshape(-1, 3)),
        Mesh(vertices[skin_rows].float(), skin_local.reshape(-1, 3)),
        skin_rows,
        ~cut_joined[joined.of[rows]],
        landmarks,
    )


def _is_called(block: Block, names: re.Pattern[str]) -> bool:
    """Whether a block's name, or that of its one material, is one of these."""
    named = (block.name, *(block.materials if len(block.materials) == 1 else ()))
    return any(names.search(name) for name in named)


def find_skin(vertices: Tensor, faces: Tensor, part: Tensor, placed: Tensor) -> tuple[int, Tensor, float]:
    """The part that most of the found points lie on, which points do, (68+P,) bool, and how far it faces the viewer."""
    known = torch.isfinite(placed).all(-1)
    nearest = SurfaceIndex(vertices, faces).nearest(placed[known])
    owner = part[faces[nearest.triangle, 0]]
    skin = int(owner.bincount().argmax())
    on_skin = torch.zeros(len(placed), dtype=torch.bool)
    on_skin[known] = owner == skin
    normals = triangle_normals(vertices, faces[nearest.triangle[owner == skin]])
    return skin, on_skin, float(normals[:, 2].mean())


def _moves(own: Tensor, placed: Tensor, skin: cKDTree) -> bool:
    """Whether a loose part (n,3) belongs to eyes or mouth, or is on the face as brows, lashes and beards are."""
    for eye in EYES:
        lids = placed[eye]
        centre = lids[torch.isfinite(lids).all(-1)].mean(0)
        if bool(((own - centre).norm(dim=-1) < _EYE_REACH).all()):
            return True
    lips = placed[_LIPS]
    lips = lips[torch.isfinite(lips).all(-1)].mean(0)
    at = own.mean(0) - lips
    inside = bool(((own - lips).norm(dim=-1) < _MOUTH_REACH).all())
    if inside and float(at[2]) < _BEFORE_LIPS and abs(float(at[1])) < _MOUTH_HEIGHT:
        return True
    away = float((own - placed[torch.isfinite(placed).all(-1)].mean(0)).norm(dim=-1).max())
    if away > _BEARD_REACH:
        return False
    height = skin.query(own.numpy())[0]
    tuft = float((own.amax(0) - own.amin(0)).max()) < _TUFT and height.min() < _ROOTED
    return bool(tuft or (away < _FACE_REACH and (height < _SKIN_REACH).all()))


def _landmarks(reference: Mesh, points: ReferencePoints, placed: Tensor, on_skin: Tensor) -> Landmarks:
    """The finder's points on the face as pairs, without those that are far from where the others say they are."""
    astray = (placed - points.all).norm(dim=-1)
    usable = on_skin & (astray < max(_LEAST_ASTRAY, _ASTRAY * float(astray[on_skin].median())))
    if len(points.points):  # iBUG's 68 follow annotators' habits, the finder's other points the head
        usable[:COUNT] = False
    ids = torch.cdist(points.all, reference.vertices.double()).argmin(1)
    return ids[usable], placed[usable]


def with_edges(landmarks: Landmarks, reference: Mesh, head: SkinOfHead, placed: Tensor) -> Landmarks:
    """The pairs with the edges of lids and lips in place of the finder's points there, where these can be seen."""
    regions = reference.regions
    eyeballs = regions["eyeball_left"] | regions["eyeball_right"]
    rest = reference.vertices.double()
    template = SkinOfHead(rest, reference.faces, eyeballs, eyeballs.long())
    marks = rest[reference.landmarks]
    seen = [*eyes_seen(head, placed), _lips_seen(head, placed)]
    known = [*eyes_seen(template, marks), _lips_seen(template, marks)]
    rims = [(regions[lids] & ~eyeballs,) * 2 for lids in ("lids_right", "lids_left")]
    rims.append((regions["upper_lip"], regions["lower_lip"]))
    ids, targets = landmarks
    for own, there, around in zip(seen, known, rims, strict=True):
        if own is None or there is None:
            continue
        shares = _SHARES[(own.share.min() <= _SHARES) & (own.share.max() >= _SHARES)]
        pairs, points = [], []
        for edge, place, region in zip(there.at(shares), own.at(shares), around, strict=True):
            rim = region.nonzero()[:, 0]
            nearest = torch.cdist(edge, rest[rim]).argmin(1)
            pairs.append(rim[nearest])
            points.append(place + (rest[rim[nearest]] - edge))
        outside = ~(around[0] | around[1])[ids]
        ids = torch.cat([ids[outside], *pairs])
        targets = torch.cat([targets[outside], *points])
    return ids, targets


def _lips_seen(head: SkinOfHead, marks: Tensor) -> Opening | None:
    """The edges of the lips, by iBUG's 68 marks (68,3) of the head; NaN where one is not known."""
    joined, lips = joined_vertices(head.vertices, head.skin), marks[_LIPS]
    lips = lips[torch.isfinite(lips).all(-1)]
    return lip_line(joined.vertices, joined.faces, lips) if len(lips) else None


def plain_surface(vertices: Tensor, faces: Tensor, color: Sequence[float] = (1.0, 1.0, 1.0, 1.0)) -> TexturedSurface:
    """A surface of one colour, white clay if absent: vertices (V,3), faces (F,3)."""
    clay = (Material(torch.tensor(color)),)
    return TexturedSurface(
        vertices, faces, torch.zeros(len(vertices), 2), torch.zeros(len(faces), dtype=torch.int64), clay
    )

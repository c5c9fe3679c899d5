"""A painted head with marker balls under a helmet's rim, lit from where the camera is."""

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.raycast import RayCaster
from torchface.rig import BlendshapeRig

from .helmet_camera import helmet_plates

MARKER_RADIUS = 1.7
_MARKER_GREY, _PAINT_GREY, _SKIN_GAIN = 1.5, 1.25, 0.72
_SENSITIVITY = torch.tensor([0.45, 0.40, 0.15])  # such cameras see much of the red
_DISTANCE = 230.0  # at which a surface is as bright as its grey says, millimetres


class HeadCameraRenderer:
    """Front of the head, with paint (size,size), helmet plates and marker balls as one mesh that moves."""

    def __init__(self, rig: BlendshapeRig, paint: Tensor, attachment: Attachment) -> None:
        mesh = rig.neutral
        assert mesh.uvs is not None
        assert mesh.uv_faces is not None
        front = ((rig.vertices[:, 2] > -10) & (rig.vertices[:, 1] > -150))[mesh.faces].all(1)
        used, self.faces = mesh.faces[front].unique(return_inverse=True)
        self.rest, self.deltas = rig.vertices[used].double(), rig.deltas[:, used].double()
        self.uvs = mesh.uvs[mesh.uv_faces[front]].float()
        grey = torch.einsum("chw,c->hw", mesh.texture, _SENSITIVITY)
        paint = torch.nn.functional.interpolate(paint[None, None], grey.shape, mode="bilinear")[0, 0]
        self.textures = torch.stack([_SKIN_GAIN * grey, paint])
        row = torch.full((len(mesh.faces),), -1, dtype=torch.int64)
        row[front] = torch.arange(int(front.sum()))
        visible = row[attachment.triangles] >= 0
        self.markers = Attachment(row[attachment.triangles[visible]], attachment.barycentric[visible])
        self.ball, ball_faces = _ball(MARKER_RADIUS)
        count = int(visible.sum())
        first = len(used) + len(self.ball) * torch.arange(count)[:, None, None]
        self.plates, plate_faces, plate_greys = helmet_plates()
        self.all_faces = torch.cat([
            self.faces, (ball_faces + first).view(-1, 3), plate_faces + len(used) + count * len(self.ball),
        ])  # fmt: skip
        # What a triangle outside the skin throws back; the skin's own comes from its textures.
        self.greys = torch.cat([
            torch.zeros(len(self.faces)), torch.full((count * len(ball_faces),), _MARKER_GREY), plate_greys,
        ])  # fmt: skip

    def render(self, weights: Tensor, centre: Tensor, ways: Tensor) -> Tensor:
        """Light (R,) that comes back along rays from the camera's centre."""
        skin = self.rest + torch.einsum("n,nvc->vc", weights.double(), self.deltas)
        normals = vertex_normals(skin, self.faces)
        lifted = self.markers.on(self.faces, skin) + MARKER_RADIUS * self.markers.on(self.faces, normals)
        vertices = torch.cat([skin, (lifted[:, None] + self.ball).view(-1, 3), self.plates])
        hits = RayCaster(vertices, self.all_faces).cast(centre.expand_as(ways), ways)
        light = torch.zeros(len(ways))
        seen = hits.triangle >= 0
        light[seen] = self.greys[hits.triangle[seen]]
        on_skin = seen & (hits.triangle < len(self.faces))
        triangle, barycentric = hits.triangle[on_skin], hits.barycentric[on_skin]
        uv = (self.uvs[triangle] * barycentric[..., None]).sum(1)
        grey, paint = sample_texture(self.textures, uv).unbind(1)
        normal = (normals[self.faces[triangle]] * barycentric[..., None]).sum(1)
        cosine = (torch.nn.functional.normalize(normal, dim=-1) * ways[on_skin]).sum(-1).abs().float()
        nearer = (_DISTANCE / hits.distance[on_skin]).float() ** 2
        back = torch.lerp(grey * (0.12 + 0.88 * cosine), _PAINT_GREY * (0.45 + 0.55 * cosine), paint)
        gloss = 0.25 * cosine**40 * (1 - paint)
        light[on_skin] = nearer * (back + gloss * grey)
        return light


def _ball(radius: float, rings: int = 4, segments: int = 6) -> tuple[Tensor, Tensor]:
    """A sphere round the origin: vertices (V,3), faces (F,3)."""
    down = torch.pi * torch.arange(1, rings, dtype=torch.float64) / rings
    angle = 2 * torch.pi * torch.arange(segments, dtype=torch.float64) / segments
    belt = torch.stack([
        torch.outer(down.sin(), angle.cos()),
        down.cos()[:, None].expand(-1, segments),
        torch.outer(down.sin(), angle.sin()),
    ], dim=-1).view(-1, 3)  # fmt: skip
    poles = torch.tensor([[0.0, 1, 0], [0, -1, 0]], dtype=torch.float64)
    ids = torch.arange(len(belt)).view(rings - 1, segments)
    a, b = ids[:-1], ids[1:]
    c, d = b.roll(-1, 1), a.roll(-1, 1)
    sides = torch.cat([torch.stack([a, d, b], -1).view(-1, 3), torch.stack([d, c, b], -1).view(-1, 3)])
    top, bottom = torch.full((segments,), len(belt)), torch.full((segments,), len(belt) + 1)
    caps = torch.cat([
        torch.stack([top, ids[0].roll(-1), ids[0]], -1), torch.stack([bottom, ids[-1], ids[-1].roll(-1)], -1)
    ])  # fmt: skip
    return radius * torch.cat([belt, poles]), torch.cat([sides, caps])

"""One light near a face and light from everywhere, reflected as by chalk."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.pinhole import Camera
from torchface.mesh import Mesh
from torchface.rendering.clay_shading import sample_texture
from torchface.rendering.raycast import RayCaster

__all__ = ["PointLight", "vertex_albedo"]

MAX_DISTANCE = 100_000.0  # millimetres; a light 100 m away shines from one direction: the directional limit

_OFF_THE_SKIN = 0.4  # millimetres; a ray that starts on the skin would hit it


@dataclass(frozen=True, eq=False)
class PointLight:
    r"""Light from one point and from everywhere, linear, standing still beside the camera.

    Light and surface meet only in products (:math:`I_a K_a` and :math:`I_p K_d`): a bright source on dark skin looks
    like a dim one on bright skin. The coefficients K are therefore 1, and what is here are the products
    beside the albedo that was given. Distance does not dim the light.

    Args:
        ambient: :math:`I_a` of red, green, blue, (3,); 1 shows the albedo as it is.
        intensity: :math:`I_p`, (3,); 1 shows the albedo as it is where the light comes straight on.
        position: of the source in the camera's frame (x right, y down, z forward), (3,), millimetres.

    Raises:
        ShapeError: a tensor is not (3,).
        ValueRangeError: a number is NaN or infinite, or a strength negative.

    Source: thesis 4.2.11, equation 66.

    Example:
        >>> source = PointLight.directional(torch.ones(3), torch.ones(3), torch.tensor([0.0, -1.0, 0.0]))
        >>> source.toward(torch.zeros(1, 3)).round(decimals=3).abs().tolist()  # from above, y down
        [[0.0, 1.0, 0.0]]
    """

    ambient: Tensor
    intensity: Tensor
    position: Tensor

    def __post_init__(self) -> None:
        for name in ("ambient", "intensity", "position"):
            value = getattr(self, name)
            if value.shape != (3,):
                raise ShapeError(f"light: found {name} {tuple(value.shape)}, expected (3,)")
            if not bool(torch.isfinite(value).all()) or (name != "position" and bool((value < 0).any())):
                raise ValueRangeError(
                    f"light: found {name} {value.tolist()}, expected finite numbers, strengths not negative"
                )

    @staticmethod
    def directional(ambient: Tensor, intensity: Tensor, direction: Tensor) -> "PointLight":
        """A light so far away that it shines from one direction (3,), from the face toward the light."""
        return PointLight(ambient, intensity, MAX_DISTANCE * torch.nn.functional.normalize(direction, dim=0))

    def toward(self, points: Tensor) -> Tensor:
        """Unit vectors L from points (...,3) in the camera's frame to the source."""
        return torch.nn.functional.normalize(self.position.to(points) - points, dim=-1)

    def from_afar(self, point: Tensor) -> "PointLight":
        """A directional light that comes to a point (3,) of the camera's frame from where this one does."""
        return PointLight.directional(self.ambient, self.intensity, self.toward(point.to(self.position)))

    def on_front(self, least: float = -1.0) -> Tensor:
        r"""A far light on a ball that the camera sees, in the mean over its disc in the picture, (3,).

        .. math:: I_a + I_p\, \frac{2}{3 \pi} (\sin\theta + (\pi - \theta) \cos\theta)

        Args:
            least: of the cosine of :math:`\theta`, between the source and the camera; 0 takes one behind the ball as
                one beside it.
        """
        toward = torch.nn.functional.normalize(self.position.double(), dim=0)
        angle = math.acos(min(max(-float(toward[2]), least), 1.0))
        share = (math.sin(angle) + (math.pi - angle) * math.cos(angle)) * 2 / (3 * math.pi)
        return self.ambient + self.intensity * share


def irradiance(points: Tensor, normals: Tensor, light: PointLight, lit: Tensor | None = None) -> Tensor:
    r"""What a light brings to points of a surface, by which the albedo is multiplied; linear, differentiable, (...,3).

    .. math:: I_v = I_a + I_p\, \max(0, N_v \cdot L_v)

    Args:
        points: in the camera's frame, (...,3), millimetres.
        normals: unit, (...,3).
        lit: the share of the source that each point sees, (...,); all if absent.

    Source: thesis 4.2.11, equation 66.
    """
    falling = (normals * light.toward(points)).sum(-1).clamp(min=0)
    if lit is not None:
        falling = falling * lit
    return light.ambient.to(points) + light.intensity.to(points) * falling[..., None]


def lit_by(position: Tensor, caster: RayCaster, points: Tensor, normals: Tensor) -> Tensor:
    """Whether each point (Q,3) faces a source at ``position``, (3,) or (Q,3), with nothing of the mesh between, (Q,)
    bool."""
    toward = torch.nn.functional.normalize(position.double() - points.double(), dim=-1)
    facing = (toward * normals).sum(-1) > 0
    asked = facing.nonzero()[:, 0]
    starts = points[asked].double() + _OFF_THE_SKIN * (normals[asked].double() + toward[asked])
    lit = facing.clone()
    lit[asked] = ~caster.occluded(starts, toward[asked])
    return lit


def in_camera_frame(camera: Camera, vertices: Tensor) -> Tensor:
    """Vertices (V,3) of the world in the camera's frame, float64."""
    return vertices.double() @ camera.rotation.T.to(vertices).double() + camera.translation.to(vertices).double()


def vertex_albedo(mesh: Mesh) -> Tensor:
    """The albedo of a mesh's vertices, (V,3) sRGB in [0,1]: its colours, else its texture read at the vertices.

    Raises:
        ValueRangeError: the mesh has neither. Colours taken from the video that is to be relit are no way out: they
            hold its light already, and the light found would be even, whatever it was.

    Example:
        >>> red = torch.tensor([[1.0, 0, 0]]).repeat(3, 1)
        >>> torch.equal(vertex_albedo(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]), colors=red)), red)
        True
    """
    if mesh.colors is not None:
        return mesh.colors.float()
    if mesh.texture is None or mesh.uvs is None or mesh.uv_faces is None:
        raise ValueRangeError(
            "albedo: found a mesh without colours and without a texture, expected the skin under even light: from a "
            "scan, or from a colour model such as HeadModel.color of the zoo's head; not from the video itself"
        )
    row = torch.zeros(len(mesh.vertices), dtype=torch.int64, device=mesh.faces.device)
    row[mesh.faces.flatten()] = mesh.uv_faces.flatten()
    return sample_texture(mesh.texture, mesh.uvs[row].float())

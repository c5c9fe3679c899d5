"""Shape and colour of heads together, on one topology."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchface.errors import FileFormatError, TopologyError
from torchface.files.documents import Value
from torchface.mesh import Annotations, Mesh, submesh
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.number_checks import as_tensor, checked_type
from torchface.rig import BlendshapeRig

_MAX_BYTES = 2**31
_MAX_SHAPES = _MAX_REGIONS = 1000
_TOPOLOGY = ("faces", "polygons", "uvs", "uv_faces", "landmarks", "mirror", "contacts")


class Heads(NamedTuple):
    """Vertices (B,V,3) in millimetres and colours (B,V,3), where they were asked for.

    Example:
        >>> from torchface import zoo
        >>> model = zoo.get_model("head")
        >>> heads = model(torch.zeros(2, model.shape.count))
        >>> len(heads.vertices), heads.colors is None
        (2, True)
    """

    vertices: Tensor
    colors: Tensor | None


class HeadModel(nn.Module):
    """A morphable model of shape, one of colour, and the topology that both live on.

    Args:
        shape: of positions, millimetres.
        color: of vertex colours, linear in the values that textures hold; None where none were seen.
        faces: triangles (F,3) int64.
        polygons: the faces as authored, (P,K), padded with -1.
        uvs: texture coordinates (U,2).
        uv_faces: their rows at each triangle's corners (F,3).
        annotations: landmarks, regions, mirror map and contact pairs.
        rig: the template whose shapes heads of this model are given, on the same topology; it may stand elsewhere.

    Raises:
        TopologyError: shape, colour, faces and rig have different vertices.
        ShapeError: a tensor has the wrong shape.

    Source: thesis 3.2.4.

    Example:
        >>> from torchface import zoo
        >>> model = zoo.get_model("head")
        >>> average = model.mesh(torch.zeros(model.shape.count))
        >>> len(average.landmarks), torch.equal(average.vertices, model.template().vertices)
        (68, True)
    """

    faces: Tensor
    polygons: Tensor | None
    uvs: Tensor | None
    uv_faces: Tensor | None
    landmarks: Tensor | None
    mirror: Tensor | None
    contacts: Tensor | None
    regions: Tensor | None
    rig_vertices: Tensor | None
    rig_deltas: Tensor | None
    rig_colors: Tensor | None

    def __init__(
        self,
        shape: MorphableModel,
        color: MorphableModel | None,
        faces: Tensor,
        *,
        polygons: Tensor | None = None,
        uvs: Tensor | None = None,
        uv_faces: Tensor | None = None,
        annotations: Annotations | None = None,
        rig: BlendshapeRig | None = None,
    ) -> None:
        super().__init__()
        checked_type("shape", shape, MorphableModel)
        if color is not None:
            checked_type("color", color, MorphableModel)
        faces = as_tensor("faces", faces, "(F,3)", torch.int64)
        for name, model in (("shape", shape), ("color", color)):
            if model is not None and model.mean.shape != (len(shape.mean), 3):
                raise TopologyError(
                    f"head model: found {name} of {tuple(model.mean.shape)}, expected ({len(shape.mean)},3)"
                )
        self.shape, self.color = shape, color
        annotations = annotations or Annotations()
        tensors = {"faces": faces, "polygons": polygons, "uvs": uvs, "uv_faces": uv_faces}
        tensors |= {name: getattr(annotations, name) for name in ("landmarks", "mirror", "contacts")}
        for name in _TOPOLOGY:
            tensor = tensors[name]
            self.register_buffer(name, None if tensor is None else tensor.detach().to(shape.mean.device).contiguous())
        self.region_names = sorted(annotations.regions)
        masks = [annotations.regions[name].to(shape.mean.device) for name in self.region_names]
        self.register_buffer("regions", torch.stack(masks) if masks else None)
        if rig is not None and rig.vertices.shape != shape.mean.shape:
            raise TopologyError(f"head model: found a rig of {len(rig.vertices)}, expected {len(shape.mean)} vertices")
        if rig is None:
            self._carry((), None, None, None)
        else:
            rig = rig.linear("HeadModel")
            self._carry(rig.names, rig.vertices, rig.deltas, rig.neutral.colors)

    def _carry(
        self, names: Sequence[str], vertices: Tensor | None, deltas: Tensor | None, colors: Tensor | None
    ) -> None:
        self.rig_names = tuple(names)
        for name, tensor in (("rig_vertices", vertices), ("rig_deltas", deltas), ("rig_colors", colors)):
            kept = None if tensor is None else tensor.detach().float().to(self.shape.mean.device).clone()
            self.register_buffer(name, kept)

    @classmethod
    def on(
        cls,
        template: Mesh,
        shape: MorphableModel,
        color: MorphableModel | None = None,
        rig: BlendshapeRig | None = None,
    ) -> "HeadModel":
        """The models with the topology and annotations of a mesh, and a rig of that topology.

        Raises:
            TopologyError: other triangles than the rig's.
        """
        if rig is not None and not torch.equal(rig.neutral.faces.cpu(), template.faces.cpu()):
            raise TopologyError(
                f"head model: found a rig of {len(rig.vertices)} vertices and {len(rig.neutral.faces)} triangles, "
                f"expected the heads' {len(template.vertices)} and {len(template.faces)}"
            )
        model = cls(
            shape,
            color,
            template.faces,
            polygons=template.polygons,
            uvs=template.uvs,
            uv_faces=template.uv_faces,
            annotations=template.annotations,
            rig=rig,
        )
        model.template()  # refuses what makes no mesh
        return model

    @property
    def annotations(self) -> Annotations:
        """Landmarks, regions, mirror map and contact pairs."""
        regions = {} if self.regions is None else dict(zip(self.region_names, self.regions, strict=True))
        return Annotations(self.landmarks, regions, self.mirror, self.contacts)

    def template(self) -> Mesh:
        """The mean head."""
        colors = None if self.color is None else self.color.mean.clamp(0, 1)
        return Mesh(
            self.shape.mean,
            self.faces,
            self.uvs,
            self.uv_faces,
            colors,
            polygons=self.polygons,
            annotations=self.annotations,
        )

    @property
    def rig(self) -> BlendshapeRig | None:
        """The template rig that travels with the model; None where the model has none."""
        if self.rig_vertices is None or self.rig_deltas is None:
            return None
        neutral = replace(self.template(), vertices=self.rig_vertices, colors=self.rig_colors)
        return BlendshapeRig(neutral, self.rig_deltas, self.rig_names)

    def part(self, keep: Tensor) -> "HeadModel":
        """The model of some vertices only: a mask (V,) or ids; see ``torchface.mesh.submesh``."""
        piece, rig = submesh(self.template(), keep), self.rig
        return HeadModel.on(
            piece.mesh,
            self.shape.part(piece.vertex_ids),
            None if self.color is None else self.color.part(piece.vertex_ids),
            None if rig is None else rig.part(keep),
        )

    def forward(self, shape_coefficients: Tensor, color_coefficients: Tensor | None = None) -> Heads:
        """Heads of coefficients (B,K) and, where given and modelled, their colours of coefficients (B,L)."""
        colors = None
        if color_coefficients is not None:
            if self.color is None:
                raise TopologyError("head model: found colour coefficients, expected none: it has no colours")
            colors = self.color(color_coefficients)
        return Heads(self.shape(shape_coefficients), colors)

    def mesh(self, shape_coefficients: Tensor, color_coefficients: Tensor | None = None) -> Mesh:
        """One head of coefficients (K,); the mean colour where none are given; colours are clipped to [0,1]."""
        colors = None if color_coefficients is None else color_coefficients[None]
        heads = self(shape_coefficients[None], colors)
        mean = self.template()
        if heads.colors is None:
            return mean.with_vertices(heads.vertices[0])
        return Mesh(
            heads.vertices[0],
            mean.faces,
            mean.uvs,
            mean.uv_faces,
            heads.colors[0].clamp(0, 1),
            polygons=mean.polygons,
            annotations=mean.annotations,
        )

    def extra_repr(self) -> str:
        shapes = f", {len(self.rig_names)} shapes" if self.rig_names else ""
        return f"{len(self.shape.mean)} vertices, {len(self.faces)} triangles{shapes}"

    def check_state(self) -> None:
        """Raises ``TorchfaceError`` where a loaded state makes no mesh or no rig."""
        self.template()
        _ = self.rig

    @property
    def config(self) -> dict[str, Any]:
        """Sizes and names from which :meth:`from_config` makes a model for the state to be loaded into."""
        sizes = {name: list(t.shape) for name in _TOPOLOGY if (t := getattr(self, name)) is not None}
        config: dict[str, Any] = {"shape": self.shape.config, "sizes": sizes, "regions": list(self.region_names)}
        if self.color is not None:
            config["color"] = self.color.config
        if self.rig_names:
            config["rig"] = {"shapes": list(self.rig_names), "colors": self.rig_colors is not None}
        return config

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "HeadModel":
        """A model of zeros with the sizes of a ``config``.

        Raises:
            FileFormatError: a size is missing, no whole number, or too large.
        """
        values = Value("config", "", config)
        shape, color = values["shape"].plain_table(), values["color"].plain_table() if values["color"] else None
        names = [name.text() for name in values["regions"].rows(0, _MAX_REGIONS)]
        tensors = {name: _zeros(name, found) for name, found in values["sizes"].table().items() if name in _TOPOLOGY}
        if "faces" not in tensors:
            raise FileFormatError("head model: found no size of the faces in the config, expected one")
        count = values["shape"]["vertices"].whole(1)
        annotations = Annotations(tensors.get("landmarks"), {}, tensors.get("mirror"), tensors.get("contacts"))
        model = cls(
            MorphableModel.from_config(shape),
            None if color is None else MorphableModel.from_config(color),
            tensors["faces"],
            polygons=tensors.get("polygons"),
            uvs=tensors.get("uvs"),
            uv_faces=tensors.get("uv_faces"),
            annotations=annotations,
        )
        if names:
            model.region_names = sorted(names)
            model.regions = torch.zeros(len(names), count, dtype=torch.bool)
        if "rig" in config:
            shapes, colored = _rig_of(values["rig"], count)
            rest = torch.zeros(count, 3)
            model._carry(shapes, rest, torch.zeros(len(shapes), count, 3), rest.clone() if colored else None)
        return model


def _rig_of(found: Value, vertices: int) -> tuple[list[str], bool]:
    """A rig's shapes by name, and whether it has colours."""
    limit = min(_MAX_SHAPES, _MAX_BYTES // (12 * vertices))
    names = [name.text() for name in found["shapes"].rows(1, limit, f"1 to {limit} names")]
    return names, found["colors"].found is True


def _zeros(name: str, found: Value) -> Tensor:
    sizes = [size.whole(0, 2**24 - 1) for size in found.rows(1, 2, "one or two whole numbers")]
    return torch.zeros(sizes, dtype=torch.float32 if name == "uvs" else torch.int64)

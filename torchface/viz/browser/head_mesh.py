"""A mesh on the page, kept up to date as it moves."""

import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from torchface.color_space import to_linear
from torchface.errors import ShapeError
from torchface.geometry.meshes.normal_maps import encode_normals
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.uv_seams import split_at_seams
from torchface.io.gltf.buffers import BufferWriter
from torchface.io.gltf.gltf_document import glb_pieces
from torchface.io.gltf.part_textures.head_primitives import ColorSource, Surface
from torchface.io.gltf.primitive_writing import PrimitiveWriter
from torchface.io.length_units import millimetres_per
from torchface.mesh import Mesh
from torchface.part_materials import SKIN
from torchface.rendering.compositing import to_pillow
from torchface.rendering.part_colors import CLAY
from torchface.viz.browser.browser_page import SCALE
from torchface.viz.browser.single_color_parts import split_parts

if TYPE_CHECKING:
    import viser

_MIN_MOVE = 1e-4
_SPARES = 3  # heads that the page reads hidden, at most
OVER = 0.12
"""Millimetres that the textured mesh lies over the pieces."""


class HeadOnPage:
    """The pieces of one mesh as nodes of the page's scene, and the textured mesh over them while it rests.

    The page shades pieces smoothly and takes new positions in place; a texture it reads only from a whole file, so
    the textured mesh follows when the head has come to rest. Wrinkles are seen in motion too, at the rate at which
    files can be made: pieces move with them then, and the page reads the next file hidden beside the one in view.

    Args:
        normal_map: gives the normal map (3,H,W) of the pose, or nothing; called at each :meth:`settle`.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        mesh: Mesh,
        name: str,
        offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
        normal_map: Callable[[], Tensor | None] | None = None,
    ) -> None:
        self._server = server
        self._parts = split_parts(mesh)
        self._vertices, self._faces = mesh.vertices.detach().cpu().float(), mesh.faces.cpu()
        self._normal_map = normal_map if mesh.uvs is not None else None
        has_colors = (mesh.texture is not None and mesh.uvs is not None) or mesh.colors is not None
        self._textured = TexturedHead(mesh) if has_colors or self._normal_map is not None else None
        self._texture_enabled, self._wrinkled = True, True
        self._stale = False
        self._sent: list[tuple[Any, Tensor]] = []  # not in view yet, the oldest first
        origin = SCALE * np.array(offset)
        self._nodes = [
            server.scene.add_mesh_simple(
                f"/{name}/part{number}",
                self._vertices[part.vertex_ids].numpy(),
                part.faces.numpy(),
                color=part.color,
                scale=SCALE,
                side="double",
                position=origin,
                cast_shadow=False,
                receive_shadow=False,
            )
            for number, part in enumerate(self._parts)
        ]
        self._textured_nodes: list[Any] = []
        spares = [f"next{number}" for number in range(_SPARES)] if self._normal_map else []
        for spare in ["textured", *spares] if self._textured else []:
            node = server.scene.add_glb(
                f"/{name}/{spare}",
                self._glb(),
                scale=SCALE * millimetres_per("m"),
                position=origin,
                visible=spare == "textured",
                cast_shadow=False,
                receive_shadow=False,
            )
            self._textured_nodes.append(node)

    @property
    def has_texture(self) -> bool:
        """Whether the mesh brought a texture, vertex colours or wrinkle maps."""
        return self._textured is not None

    @property
    def settled(self) -> bool:
        """Whether nothing is left for :meth:`settle` to do."""
        return not self._texture_enabled or not (self._stale or self._sent)

    @property
    def follows(self) -> bool:
        """Whether the textured mesh is shown in motion, for its wrinkles."""
        return self._normal_map is not None and self._texture_enabled and self._wrinkled

    def show(self, vertices: Tensor) -> int:
        """Moves the vertices (V,3), millimetres; returns how many pieces were sent, the others having stayed."""
        if vertices.shape != self._vertices.shape:
            raise ShapeError(f"vertices: found {tuple(vertices.shape)}, expected {tuple(self._vertices.shape)}")
        new = vertices.detach().cpu().float()
        moved = (new - self._vertices).abs().amax(1) > _MIN_MOVE
        # What stays below the threshold adds up: only what was sent counts as shown.
        self._vertices = torch.where(moved[:, None], new, self._vertices)
        with self._server.atomic():
            sent = self._move(self._vertices) if not self.follows else int(moved.any())
            if sent and self._textured_nodes:
                self._stale = True
                if not self.follows:
                    self._hide()
        return sent

    def _move(self, vertices: Tensor) -> int:
        """Sends the pieces that the page has elsewhere; how many."""
        sent = 0
        for part, node in zip(self._parts, self._nodes, strict=True):
            here = vertices[part.vertex_ids].numpy()
            if not np.array_equal(here, node.vertices):
                node.vertices = here
                sent += 1
        return sent

    def settle(self, calls: int = 1) -> None:
        """Shows the texture, where the head has one that is not shown; one with wrinkles, which the page has to
        read, after so many calls more."""
        if self.settled:
            return
        with self._server.atomic():
            del self._sent[: max(len(self._sent) - min(calls, _SPARES), 0)]
            if self._sent and (len(self._sent) == min(calls, _SPARES) or not self._stale):
                node, vertices = self._sent.pop(0)
                self._hide()
                node.visible = True
                self._move(vertices)
            if self._stale:
                waiting = [node for node, _ in self._sent]
                spare = (node for node in self._textured_nodes if not node.visible and node not in waiting)
                node = next(spare, self._textured_nodes[0])
                node.glb_data = self._glb()
                self._stale = False
                if len(self._textured_nodes) == 1:
                    node.visible = True
                else:
                    self._sent.append((node, self._vertices))

    def _glb(self) -> bytes:
        assert self._textured is not None
        over = self._vertices + OVER * vertex_normals(self._vertices, self._faces)
        return self._textured.glb(over, None if self._normal_map is None else self._normal_map())

    def _hide(self) -> None:
        for node in self._textured_nodes:
            node.visible = False

    def refresh_texture(self, wrinkled: bool | None = None) -> None:
        """Marks the texture as out of date, so that the next :meth:`settle` makes it anew, with wrinkles or without."""
        self._stale = bool(self._textured_nodes)
        if wrinkled is not None:
            self._wrinkled = wrinkled

    def enable_texture(self, enabled: bool) -> None:
        """Shows the texture, or never."""
        self._texture_enabled = enabled
        self._move(self._vertices)
        if enabled:
            self.settle()
        else:
            self._hide()
            self._stale, self._sent = bool(self._textured_nodes), []


_MAX_SIDE = 2048
_MAX_NORMALS_SIDE = 1024
_QUALITY = 90
_ROUGHNESS = 0.72


class TexturedHead:
    """A mesh's material, prepared once, of its texture, vertex colours or clay; positions and normal map go in each
    time."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh = mesh.to("cpu")
        uv_faces = None if mesh.uv_faces is None else mesh.uv_faces.numpy()
        self._split = split_at_seams(len(mesh.vertices), mesh.faces.numpy(), uv_faces)
        textured = mesh.texture is not None and mesh.uvs is not None
        source: ColorSource = "texture" if textured else "material" if mesh.colors is None else "colors"
        self._surface = Surface(torch.arange(len(mesh.faces)), SKIN, source)
        self._image = _encoded(mesh.texture, "JPEG", _MAX_SIDE) if textured and mesh.texture is not None else None
        self._color = [*to_linear(torch.tensor(CLAY)).tolist(), 1.0] if source == "material" else None

    def glb(self, vertices: Tensor, normal_map: Tensor | None = None) -> bytes:
        """A ``.glb`` of vertices (V,3), in metres, with a normal map (3,H,W) where the mesh has UVs."""
        buffers = BufferWriter()
        mesh = self._mesh.with_vertices(vertices.detach().cpu().float())
        primitive = PrimitiveWriter(mesh, self._split, buffers).add(self._surface, 0, torch.zeros(3))
        shading: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": _ROUGHNESS}
        material: dict[str, Any] = {"pbrMetallicRoughness": shading, "doubleSided": True}
        root: dict[str, Any] = {
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            "materials": [material],
        }
        if self._image is not None:
            shading["baseColorTexture"] = {"index": buffers.texture(root, self._image, "image/jpeg")}
        elif self._color is not None:
            shading["baseColorFactor"] = self._color
        if normal_map is not None and mesh.uvs is not None:
            image = _encoded(encode_normals(normal_map.cpu().float()), "PNG", _MAX_NORMALS_SIDE)
            material["normalTexture"] = {"index": buffers.texture(root, image)}
        return b"".join(glb_pieces(root, buffers))


def _encoded(image: Tensor, kind: str, max_side: int) -> bytes:
    shrunk: Image.Image = to_pillow(image)
    shrunk.thumbnail((max_side, max_side))
    file = io.BytesIO()
    shrunk.save(file, kind, **({"quality": _QUALITY} if kind == "JPEG" else {"compress_level": 1}))
    return file.getvalue()

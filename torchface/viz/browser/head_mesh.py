"""A mesh on the page, kept up to date as it moves."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchface.errors import ShapeError
from torchface.mesh import Mesh
from torchface.viz.browser.browser_page import SCALE
from torchface.viz.browser.colored_pieces import split_parts
from torchface.viz.browser.textured_head import Skin

if TYPE_CHECKING:
    import viser

_STILL = 1e-4
_SKIN_SCALE = 1.0008


class HeadOnPage:
    """The pieces of one mesh as nodes of the page's scene, and its textured skin over them while it rests.

    The page shades pieces smoothly and takes new positions in place; a texture it reads only from a whole file, so
    the skin follows when the head has come to rest.

    Args:
        server: the page.
        mesh: what to show, millimetres.
        name: of its nodes.
        offset: where to, millimetres.
        wrinkles: gives the normal map (3,H,W) of the moment, or nothing; asked when the head has come to rest.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        mesh: Mesh,
        name: str,
        offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
        wrinkles: Callable[[], Tensor | None] | None = None,
    ) -> None:
        self._server = server
        self._parts = split_parts(mesh)
        self._vertices = mesh.vertices.detach().cpu().float()
        self._wrinkles = wrinkles if mesh.uvs is not None else None
        worn = (mesh.texture is not None and mesh.uvs is not None) or mesh.colors is not None
        self._skin = Skin(mesh) if worn or self._wrinkles is not None else None
        self._skin_shown = False
        self._skin_enabled = True
        place = SCALE * np.array(offset)
        self._nodes = [
            server.scene.add_mesh_simple(
                f"/{name}/part{number}",
                self._vertices[part.vertex_ids].numpy(),
                part.faces.numpy(),
                color=part.color,
                scale=SCALE,
                side="double",
                position=place,
                cast_shadow=False,
                receive_shadow=False,
            )
            for number, part in enumerate(self._parts)
        ]
        self._skin_node = None
        if self._skin is not None:
            centre = (self._vertices.amin(0) + self._vertices.amax(0)) / 2
            held = place + SCALE * (1 - _SKIN_SCALE) * centre.double().numpy()
            self._skin_node = server.scene.add_glb(
                f"/{name}/skin",
                self._glb(self._skin),
                scale=SCALE * _SKIN_SCALE,  # a hair larger about its centre, so that it covers the pieces
                position=held,
                cast_shadow=False,
                receive_shadow=False,
            )
            self._skin_shown = True

    @property
    def vertices(self) -> Tensor:
        """Where the page shows the vertices, (V,3), millimetres."""
        return self._vertices

    @property
    def has_skin(self) -> bool:
        """Whether the mesh brought a texture, vertex colours or wrinkle maps."""
        return self._skin is not None

    @property
    def settled(self) -> bool:
        """Whether nothing is left for :meth:`settle` to do."""
        return self._skin is None or self._skin_shown or not self._skin_enabled

    def show(self, vertices: Tensor) -> int:
        """Moves the vertices (V,3), millimetres; returns how many pieces were sent, the others having stayed."""
        if vertices.shape != self._vertices.shape:
            raise ShapeError(f"vertices: found {tuple(vertices.shape)}, expected {tuple(self._vertices.shape)}")
        new = vertices.detach().cpu().float()
        moved = (new - self._vertices).abs().amax(1) > _STILL
        sent = 0
        with self._server.atomic():
            for part, node in zip(self._parts, self._nodes, strict=True):
                if moved[part.vertex_ids].any():
                    node.vertices = new[part.vertex_ids].numpy()
                    sent += 1
            if sent and self._skin_shown and self._skin_node is not None:
                self._skin_node.visible = False
                self._skin_shown = False
        # What stays below the threshold adds up: only what was sent counts as shown.
        self._vertices = torch.where(moved[:, None], new, self._vertices)
        return sent

    def settle(self) -> None:
        """Puts the skin on, where the head has one that it does not wear."""
        if self.settled or self._skin_node is None or self._skin is None:
            return
        with self._server.atomic():
            self._skin_node.glb_data = self._glb(self._skin)
            self._skin_node.visible = True
        self._skin_shown = True

    def _glb(self, skin: Skin) -> bytes:
        return skin.glb(self._vertices, None if self._wrinkles is None else self._wrinkles())

    def refresh_skin(self) -> None:
        """Takes the skin off, so that the next :meth:`settle` puts a new one on."""
        self._skin_shown = False

    def wear_skin(self, enabled: bool) -> None:
        """Allows or forbids the skin."""
        self._skin_enabled = enabled
        if enabled:
            self.settle()
        elif self._skin_node is not None:
            self._skin_node.visible = False
            self._skin_shown = False

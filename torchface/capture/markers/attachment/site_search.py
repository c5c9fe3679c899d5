"""Triangles of the skin on which a marker may sit: near at rest, or moving like the marker."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.attachment.best_sites import PathMoments
from torchface.capture.markers.surface_motion import SurfaceMotion

_CANDIDATES = 24
# Of so many triangles about a site those whose motion is most like the marker's are candidates, too.
_NEIGHBOURHOOD, _SIMILAR = 400, 12


class SiteSearch:
    """Candidate triangles for sites; all on the skin, if the initial guess is."""

    def __init__(self, motion: SurfaceMotion, initial: Attachment) -> None:
        # Sites on another part, such as teeth, keep to the triangles of their own part.
        skin = motion.skin if bool(motion.skin[initial.triangles].all()) else torch.ones_like(motion.skin)
        self.rows = skin.nonzero()[:, 0]
        self._faces = motion.faces
        self._tree = cKDTree(motion.points[motion.faces[self.rows], :, 0].mean(1).numpy())

    def near(self, points: Tensor, count: int = _CANDIDATES) -> Tensor:
        """Rows of the faces nearest to points (M,3) at rest, (M,Q)."""
        count = min(count, len(self.rows))
        found = torch.from_numpy(self._tree.query(points.numpy(), k=count)[1])
        return self.rows[found.reshape(len(points), count)]

    def similar_motion(self, lifted: Tensor, points: Tensor, moments: PathMoments) -> Tensor:
        """Of the faces round points (M,3) those whose middle moves most like the marker, (M,Q): across the lips, say.

        Args:
            lifted: affine maps of the vertices, (V,3,N+1).
            points: the sites at rest.
            moments: of the take.
        """
        around = self.near(points, _NEIGHBOURHOOD)
        used, row = around.unique(return_inverse=True)
        middle = (lifted[self._faces[used]].mean(1) @ moments.factor).flatten(1)
        distance = torch.cdist(moments.path.flatten(1), middle).gather(1, row)
        best = distance.topk(min(_SIMILAR, around.shape[1]), dim=1, largest=False).indices
        return around.gather(1, best)

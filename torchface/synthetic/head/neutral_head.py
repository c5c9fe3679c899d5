"""The neutral head of any identity: positions, quads, texture coordinates, annotations, skin."""

from torch import Tensor

from torchface.mesh import Mesh
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.identity import Anatomy, anatomy
from torchface.synthetic.head.skin_texture import skin_texture
from torchface.synthetic.head.topology import topology
from torchface.synthetic.head.uv_layout import unwrapping


def neutral_head(identity: Tensor | None = None, texture: bool = True) -> Mesh:
    """The neutral face of one person.

    Args:
        identity: coefficients (K,) in standard deviations, in the order of ``IDENTITY``; the mean if absent.
        texture: with painted skin.

    Returns:
        A mesh of quads with seams, 68 iBUG landmarks, regions, mirror map and contact pairs; float32. The lips stand
        0.1 mm apart, the lids are open.

    Raises:
        ShapeError: ``identity`` is not (K,).
        ValueRangeError: a coefficient is NaN or infinite.

    Example:
        >>> head = neutral_head(texture=False)
        >>> height = head.vertices[:, 1].max() - head.vertices[:, 1].min()
        >>> len(head.landmarks), bool(150 < height < 400)
        (68, True)
    """
    return dress(anatomy(identity), texture)


def dress(person: Anatomy, texture: bool) -> Mesh:
    """The mesh of a head whose positions are known."""
    t, flat = topology(), unwrapping()
    return Mesh.from_polygons(
        person.vertices.float(),
        t.quads.clone(),
        flat.uvs.clone(),
        flat.quads.clone(),
        annotations=head_annotations(),
        texture=skin_texture() if texture else None,
    )

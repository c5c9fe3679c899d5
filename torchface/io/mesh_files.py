"""Meshes by path: OBJ, PLY, STL, OFF, glTF, USD."""

from pathlib import Path

from torchface.files.whole_files import check_ending
from torchface.io.gltf.gltf_reading import read_gltf_mesh
from torchface.io.gltf.gltf_writing import save_gltf_mesh
from torchface.io.meshes.obj import read_obj, write_obj
from torchface.io.meshes.off import read_off, write_off
from torchface.io.meshes.ply import read_ply, write_ply
from torchface.io.meshes.stl import read_stl, write_stl
from torchface.io.usd.usd_reading import read_usd_mesh
from torchface.io.usd.usd_writing import USD_ENDINGS, write_usd_mesh
from torchface.mesh import Mesh
from torchface.number_checks import checked_path, checked_type

_READERS = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".off": read_off}
_WRITERS = {
    **{".obj": write_obj, ".ply": write_ply, ".stl": write_stl, ".off": write_off, ".glb": save_gltf_mesh},
    **dict.fromkeys(USD_ENDINGS, write_usd_mesh),
}
_GLTF = (".glb", ".gltf", ".vrm")
MESH_ENDINGS = tuple(_READERS)  # what load_mesh reads beside glTF and USD, which may hold a rig


def load_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """A mesh in millimetres.

    Args:
        path: ``.obj`` (polygons, seams, vertex colours, the material's image), ``.ply`` (polygons, vertex colours),
            ``.stl`` (triangles, equal corners merged), ``.off`` (triangles), ``.glb``, ``.gltf`` or ``.vrm`` (the whole
            scene, morph targets at rest), ``.usd``, ``.usda``, ``.usdc`` or ``.usdz`` (the same). Vertices keep the
            file's order.
        unit: the file's, ``"um"``, ``"mm"``, ``"cm"``, ``"m"`` or ``"in"``; if absent metres for glTF, what
            the file says for USD, millimetres for the others.

    Raises:
        FileFormatError: the file is missing, broken, or of another kind.
        TopologyError: a face names a vertex that is not there.
        ValueRangeError: another unit.
        MissingExtraError: USD, and usd-core is not installed.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> save_mesh(neutral_head(texture=False), "head.obj")
        >>> len(load_mesh("head.obj").polygons)
        6380
        >>> torch.allclose(load_mesh("head.obj", unit="cm").vertices, 10 * load_mesh("head.obj").vertices)
        True
    """
    checked_path("path", path)
    check_ending(path, *_READERS, *_GLTF, *USD_ENDINGS)
    suffix = Path(path).suffix.lower()
    if suffix in _GLTF:
        return read_gltf_mesh(path, unit or "m")
    if suffix in USD_ENDINGS:
        return read_usd_mesh(path, unit)
    return _READERS[suffix](path, unit or "mm")


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Writes a mesh: ``.obj``, ``.ply``, ``.stl`` and ``.off`` in millimetres, ``.glb`` and USD in metres.

    OBJ keeps polygons, seams and colours and puts the texture beside itself; ``.glb`` and USD keep all and the
    annotations; PLY keeps polygons and colours, STL and OFF triangles. The file appears only when it is complete.

    Raises:
        FileFormatError: another ending, or the folder cannot be written to.

    Example:
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> save_mesh(head, "head.glb")
        >>> torch.equal(load_mesh("head.glb").landmarks, head.landmarks)
        True
    """
    checked_type("mesh", mesh, Mesh)
    checked_path("path", path)
    check_ending(path, *_WRITERS)
    _WRITERS[Path(path).suffix.lower()](mesh, path)

"""A USD scene as one rig: all its meshes put together, blend shapes of the same name joined."""

import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ShapeError
from torchface.files.whole_files import checked_size
from torchface.geometry.meshes.normal_maps import DetailMaps, decode_normals
from torchface.io.images.image_files import decode_image
from torchface.io.scene_processes.reading_process import read_scene
from torchface.io.scene_processes.scene_arrays import Scene, mesh_transform, scene_mesh, scene_rig, scene_weights
from torchface.io.scenes.missing_shapes import no_shapes
from torchface.io.usd.usd_library import require_usd
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.take import Take

_SECONDS_ALWAYS, _SECONDS_A_MEGABYTE = 120.0, 10.0
_PROCESS = Path(__file__).resolve().with_name("stage_process.py")


def read_usd_rig(path: str | Path, unit: str | None = None) -> BlendshapeRig:
    """The rig in a USD file: every mesh that the scene shows, in its place, blend shapes joined by name.

    Lengths become millimetres by ``metersPerUnit``, axes y up by ``upAxis``. Names are the tokens of
    ``skel:blendShapes``; in-betweens, and the combinations that torchface noted, are its correctives. Vertices and
    polygons keep the file's order; a scene of several meshes gets a region a mesh.
    The file is read by another process, whose memory and time are bounded by the files' size.

    Args:
        path: ``.usd``, ``.usda``, ``.usdc`` or ``.usdz``; what it references lies in its folder or below.
        unit: what the file's numbers are, where its ``metersPerUnit`` is wrong.
    """
    rig = scene_rig(read_stage(path), unit)
    if rig is None:
        raise no_shapes(path, "no blend shape on its meshes")
    return rig


def read_usd_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """The scene of a USD file as one mesh, blend shapes at rest; see :func:`read_usd_rig`."""
    return scene_mesh(read_stage(path), unit)


def read_usd_weights(path: str | Path) -> Take | None:
    """The weights that a file's ``SkelAnimation`` gives its shapes; none where nothing moves them."""
    return scene_weights(read_stage(path))


def read_usd_points(path: str | Path, count: int) -> tuple[Tensor, Tensor] | None:
    """The frames of a point cache of V points, as Audio2Face and other programs write it: (T,V,3), millimetres, y
    up; and the times (T,), seconds. None where no points move."""
    scene = read_stage(path, "--points", str(count))
    if not scene.record["meshes"]:
        return None
    linear, translation = mesh_transform(scene, scene.record["meshes"][0], None)
    points = scene.arrays["points"] @ linear + translation
    if not np.isfinite(points).all():
        raise FileFormatError(f"{path}: found points that are NaN or infinite, expected finite numbers")
    return torch.from_numpy(points.astype(np.float32)), torch.from_numpy(scene.arrays["times"])


def read_stage(path: str | Path, *options: str) -> Scene:
    """What the process finds in a file, see ``stage_process``."""
    require_usd()
    path = Path(path)
    size = checked_size(path)
    seconds = _SECONDS_ALWAYS + _SECONDS_A_MEGABYTE * size / 2**20
    return read_scene([sys.executable, "-P", str(_PROCESS), *options], path, "OpenUSD", seconds)


_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE = 2**28, 1024  # as of glTF's


def read_usd_detail(path: str | Path) -> DetailMaps | None:
    """The detail maps of a USD file; none where it has neither such maps nor a normal texture."""
    scene = read_stage(path, "--maps")
    allowed = max(_UNPACKED_ALWAYS, _UNPACKED_PER_BYTE * scene.record["bytes"])
    images: dict[str, Tensor] = {}
    unpacked = 0
    for name, data in scene.arrays.items():
        image = decode_image(data.tobytes(), f"{path}: its detail map {name}")
        unpacked += 4 * image.numel()
        if unpacked > allowed:
            raise FileFormatError(f"{path}: found maps that unpack to {unpacked} bytes, expected at most {allowed}")
        images[name] = decode_normals(image[:3])
    if not images:
        return None
    neutral = images.get("neutral")
    maps = [images[f"{row}"] for row in range(len(scene.record["shapes"]))]
    if len({normals.shape for normals in images.values()}) > 1:
        sizes = sorted({f"{normals.shape[2]}x{normals.shape[1]}" for normals in images.values()})
        raise FileFormatError(f"{path}: found detail maps of {' and '.join(sizes[:3])} pixels, expected one size")
    stacked = torch.stack(maps) if neutral is None or maps else neutral.new_zeros(0, *neutral.shape)
    try:
        return DetailMaps(tuple(scene.record["shapes"]), stacked, neutral)
    except (NameMismatchError, ShapeError) as error:
        raise FileFormatError(f"{path}: {error}") from error

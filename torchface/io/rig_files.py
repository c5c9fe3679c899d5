"""Rigs by path: a glTF file, a folder of OBJ files, ICT-FaceKit's folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io.gltf import read_gltf_rig, write_gltf_rig
from torchface.io.rigs.ict_facekit import is_ict_folder, load_ict_facekit, region
from torchface.io.rigs.rig_folder import load_obj_folder, save_obj_folder
from torchface.rig import BlendshapeRig


def load_rig(
    path: str | Path,
    unit: str | None = None,
    part: str | None = None,
    shapes: Sequence[str] | None = None,
    neutral: str | None = None,
) -> BlendshapeRig:
    """A rig in millimetres from where its authors left it.

    Args:
        path: a ``.glb`` or ``.gltf`` with morph targets; ICT-FaceKit's ``FaceXModel`` folder; or a folder of OBJ files,
            one of them neutral, every other a shape of its file's name.
        unit: ``"mm"``, ``"cm"`` or ``"m"``; if absent metres for glTF, centimetres for ICT, millimetres for OBJ.
        part: keep this annotated region only, such as ``"face"`` of an ICT head.
        shapes: keep these, in this order; all (for ICT the 53 expressions) if absent.
        neutral: the name of the neutral's file in an OBJ folder; if absent the one with "neutral" in it.

    Raises:
        FileFormatError: the path is missing or none of these, or a file is broken; the message names it.
        NameMismatchError: a shape or part that is not there.
        TopologyError: shapes of different vertex counts or faces.
    """
    path = Path(path)
    if path.is_dir():
        if is_ict_folder(path) and neutral is None:
            return load_ict_facekit(path, shapes, part, unit)
        rig = load_obj_folder(path, unit or "mm", neutral)
    elif path.suffix.lower() in (".glb", ".gltf") or not path.exists():
        rig = read_gltf_rig(path, unit or "m")
    else:
        raise FileFormatError(f"{path}: found a file that is no .glb or .gltf, expected one, or a folder of OBJ files")
    rig = rig if shapes is None else rig.select(shapes)
    return rig if part is None else rig.part(region(rig.neutral, part))


def save_rig(rig: BlendshapeRig, path: str | Path, detail: DetailMaps | None = None) -> None:
    """Writes a rig for other programs, and so that ``load_rig`` gives the same one.

    Args:
        rig: the rig.
        path: a ``.glb``, see ``torchface.io.gltf``; or a name without an ending, for a folder of ``neutral.obj`` and
            an OBJ a shape, see ``save_obj_folder``. It appears only when it is complete.
        detail: wrinkle maps of its shapes.

    Raises:
        FileFormatError: another ending, a folder that holds another rig, or one that cannot be written to.
        TopologyError: for a ``.glb`` the mesh has no triangle, or wrinkle maps and no texture coordinates.
        NameMismatchError: a wrinkle map belongs to no shape of the rig, or a shape's name is no file's name.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".glb":
        write_gltf_rig(rig, path, detail)
    elif suffix == "":
        save_obj_folder(rig, path, detail)
    else:
        raise FileFormatError(f"{path}: found the ending {suffix!r}, expected .glb, or none for a folder of OBJ files")

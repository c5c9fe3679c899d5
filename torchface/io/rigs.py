"""Rigs by path: a glTF file, a folder of OBJ files, ICT-FaceKit's folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from torchface.errors import FileFormatError
from torchface.files import read_file
from torchface.io.gltf import read_gltf_rig
from torchface.io.ict_facekit import is_ict_folder, load_ict_facekit, region
from torchface.io.obj import face_bytes, read_obj, read_obj_vertices
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


def load_obj_folder(folder: str | Path, unit: str = "mm", neutral: str | None = None) -> BlendshapeRig:
    """A rig of OBJ files with the same faces, shapes sorted by name.

    Args:
        folder: one neutral, and a file for each shape.
        unit: of all the files.
        neutral: the neutral's file name without ``.obj``; if absent the one file with "neutral" in its name.

    Raises:
        FileFormatError: no neutral or several, no shape, or a broken file.
        TopologyError: a shape has other vertices or faces than the neutral.
    """
    folder = Path(folder)
    files = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() == ".obj"}
    candidates = [name for name in files if "neutral" in name.lower()] if neutral is None else [neutral]
    if len(candidates) != 1 or candidates[0] not in files:
        raise FileFormatError(
            f"{folder}: found {len(files)} OBJ files, of them neutral: {', '.join(candidates) or 'none'}; expected one "
            "neutral (name it by neutral=) and a file for each shape"
        )
    rest = files.pop(candidates[0])
    if not files:
        raise FileFormatError(f"{folder}: found only the neutral {rest.name}, expected a file for each shape")
    mesh, topology = read_obj(rest, unit), face_bytes(read_file(rest))
    deltas = [read_obj_vertices(path, mesh, topology, unit) - mesh.vertices for path in files.values()]
    return BlendshapeRig(mesh, torch.stack(deltas), tuple(files))

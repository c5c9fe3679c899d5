"""FBX and Blender files by way of Blender: its Python package, or the program that a user has installed."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from torchface.errors import FileFormatError, MissingExtraError
from torchface.files.whole_files import replaced_file
from torchface.io.blender import blender_process
from torchface.io.scene_processes.reading_process import read_scene, run_process
from torchface.io.scene_processes.scene_arrays import scene_mesh, scene_rig, scene_weights
from torchface.io.scenes.weight_keys import WeightKeys
from torchface.io.usd import write_usd_rig
from torchface.io.usd.usd_reading import checked_size
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.take import Take

BLENDER_ENDINGS = (".fbx", ".blend")
PROGRAM = "TORCHFACE_BLENDER"
"""The environment variable that names the Blender to run, or a Python that has ``bpy``."""

_SECONDS_ALWAYS, _SECONDS_A_MEGABYTE = 600.0, 10.0
_INSTALL = (
    "install Blender, or bpy in a Python 3.11 of its own (python3.11 -m venv ~/bpy && ~/bpy/bin/pip install "
    f"bpy==5.0.1, then export {PROGRAM}=~/bpy/bin/python), or in a checkout pip install '.[blender]'"
)


@dataclass(frozen=True, eq=False)
class BlenderScene:
    """What a file holds: a mesh at rest, in millimetres, and where there are shape keys their rig and its animation."""

    mesh: Mesh
    rig: BlendshapeRig | None
    take: Take | None


def blender_command() -> list[str]:
    """How to run ``blender_process.py``: with what ``TORCHFACE_BLENDER`` names, ``bpy`` here, or a Blender on the path.

    Raises:
        MissingExtraError: there is none; the message says how to install it.
    """
    script = str(Path(blender_process.__file__).resolve())
    named = os.environ.get(PROGRAM)
    if named:
        program = shutil.which(os.path.expanduser(named))
        if program is None:
            raise MissingExtraError(f"{PROGRAM}: found no program {named!r}, expected Blender or a Python with bpy")
    elif importlib.util.find_spec("bpy") is not None:
        program = sys.executable
    else:
        program = shutil.which("blender")
        if program is None:
            raise MissingExtraError(f"FBX and Blender files: found neither bpy nor Blender, expected one; {_INSTALL}")
    if "python" in Path(program).name.lower():
        return [program, "-I", script]
    return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", script, "--"]


def read_blender_file(path: str | Path, unit: str | None = None) -> BlenderScene:
    """What Blender finds in an FBX or one of its own files: meshes in their places, shape keys, their animation.

    Vertices and polygons keep the order that Blender gives them; a scene of several meshes gets a region a mesh.

    Args:
        path: ``.fbx`` or ``.blend``.
        unit: what a unit of Blender's scene is, where that is no metre.

    Raises:
        MissingExtraError: there is no Blender.
        FileFormatError: Blender cannot read it, or there is no mesh in it.
    """
    path = Path(path)
    command = blender_command()
    seconds = _SECONDS_ALWAYS + _SECONDS_A_MEGABYTE * checked_size(path) / 2**20
    scene = read_scene([*command, "read"], path, "Blender", seconds)
    rig = scene_rig(scene, unit)
    return BlenderScene(scene_mesh(scene, unit) if rig is None else rig.neutral, rig, scene_weights(scene))


def write_blender_file(rig: BlendshapeRig, path: str | Path, keys: WeightKeys | None = None) -> None:
    """Writes a rig as FBX or as a Blender file, shapes as shape keys, the texture inside.

    Blender has no in-betweens: correctives of a rig are refused.

    Args:
        rig: the rig.
        path: ``.fbx`` or ``.blend``; it appears only when it is complete.
        keys: an animation of its shapes.

    Raises:
        MissingExtraError: there is no Blender, or usd-core is not installed, by which it is handed over.
        FileFormatError: it cannot be written, or the rig has correctives.
    """
    path = Path(path)
    if rig.correctives is not None:
        raise FileFormatError(
            f"{path}: found a rig with correctives, which shape keys cannot hold; expected .glb or USD"
        )
    command = blender_command()
    with tempfile.TemporaryDirectory(prefix="torchface-blender-") as folder:
        source, made = Path(folder, "rig.usdc"), Path(folder, f"made{path.suffix.lower()}")
        write_usd_rig(rig, source, keys)
        fps = 24.0 if keys is None else keys.fps
        seconds = _SECONDS_ALWAYS + _SECONDS_A_MEGABYTE * source.stat().st_size / 2**20
        said = run_process([*command, "write", str(source), str(made), repr(fps)], f"{path}", "Blender", seconds)
        if not made.is_file():
            raise FileFormatError(f"{path}: cannot be written: Blender wrote nothing{said}")
        with replaced_file(path) as temporary:
            shutil.copyfile(made, temporary)

"""FBX and Blender files by way of Blender: its Python package, or the program that a user has installed."""

import importlib.util
import json
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchface.errors import FileFormatError, MissingExtraError
from torchface.files.whole_files import checked_size, replaced_file
from torchface.io.blender import reading_in_blender, writing_in_blender
from torchface.io.gltf.corrective_extras import all_targets
from torchface.io.scene_processes.reading_process import read_scene, run_process
from torchface.io.scene_processes.scene_arrays import scene_mesh, scene_rig, scene_weights
from torchface.io.scenes.weight_keys import WeightKeys, with_correctives
from torchface.io.usd.usd_writing import write_usd_rig
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig
from torchface.take import Take

BLENDER_ENDINGS = (".fbx", ".blend")
PROGRAM = "TORCHFACE_BLENDER"  # the environment variable that names the Blender to run, or a Python that has bpy

_SECONDS_ALWAYS, _SECONDS_A_MEGABYTE = 600.0, 10.0
_INSTALL = (
    "install Blender, or bpy in a Python 3.11 of its own (python3.11 -m venv ~/bpy && ~/bpy/bin/pip install "
    f"bpy==5.0.1, then export {PROGRAM}=~/bpy/bin/python)"
)


@dataclass(frozen=True, eq=False)
class BlenderScene:
    """What a file holds: a mesh at rest, in millimetres, and where there are shape keys their rig and its animation."""

    mesh: Mesh
    rig: BlendshapeRig | None
    take: Take | None


def blender_program() -> str:
    """What ``TORCHFACE_BLENDER`` names, this Python where it has ``bpy``, or a Blender on the path.

    Raises:
        MissingExtraError: there is none; the message says how to install it.
    """
    named = os.environ.get(PROGRAM)
    if named:
        program = shutil.which(os.path.expanduser(named))
        if program is None:
            raise MissingExtraError(f"{PROGRAM}: found no program {named!r}, expected Blender or a Python with bpy")
        return program
    if importlib.util.find_spec("bpy") is not None:
        return sys.executable
    program = shutil.which("blender")
    if program is None:
        raise MissingExtraError(f"FBX and Blender files: found neither bpy nor Blender, expected one; {_INSTALL}")
    return program


def blender_command(script: str | Path) -> list[str]:
    """How to run a script of Blender's; its own words come behind."""
    program = blender_program()
    if "python" in Path(program).name.lower():
        return [program, "-I", str(script)]
    return [program, "--background", "--factory-startup", "--python-exit-code", "1", "--python", str(script), "--"]


def read_blender_file(path: str | Path, unit: str | None = None) -> BlenderScene:
    """What Blender finds in an FBX or one of its own files: meshes in their places, shape keys, their animation.

    Vertices and polygons keep the order that Blender gives them; a scene of several meshes gets a region a mesh.
    Objects that are hidden, subdivision, and on meshes with shape keys other modifiers are left out; of what is shown
    and has no place in a rig a ``UserWarning`` reports.

    Args:
        path: ``.fbx`` or ``.blend``.
        unit: what a unit of Blender's scene is, where that is no metre.

    Raises:
        MissingExtraError: there is no Blender.
        FileFormatError: Blender cannot read it, or there is no mesh in it.
    """
    path = Path(path)
    command = blender_command(Path(reading_in_blender.__file__).resolve())
    seconds = _SECONDS_ALWAYS + _SECONDS_A_MEGABYTE * checked_size(path) / 2**20
    scene = read_scene(command, path, "Blender", seconds)
    rig = scene_rig(scene, unit)
    return BlenderScene(scene_mesh(scene, unit) if rig is None else rig.neutral, rig, scene_weights(scene))


def write_blender_file(rig: BlendshapeRig, path: str | Path, keys: WeightKeys | None = None) -> None:
    """Writes a rig as FBX or as a Blender file, shapes as shape keys, the texture inside.

    A corrective is a shape key behind the shapes', what it adds. An animation has the weights that the shapes' call
    for, frame by frame; in a Blender file drivers follow the shapes' instead, so that sliders move them too. When each
    acts is noted in the object's custom property ``torchface``, by which :func:`read_blender_file` finds them again.

    Args:
        rig: the rig.
        path: ``.fbx`` or ``.blend``; it appears only when it is complete.
        keys: an animation of its shapes.

    Raises:
        MissingExtraError: there is no Blender, or usd-core is not installed, by which it is handed over.
        FileFormatError: it cannot be written.
    """
    path = Path(path)
    command = blender_command(Path(writing_in_blender.__file__).resolve())
    deltas, names = all_targets(rig)
    plain = BlendshapeRig(rig.neutral, deltas, [f"shape_{row}" for row in range(len(names))])
    if keys is not None:
        keys = with_correctives(rig, keys)
    with tempfile.TemporaryDirectory(prefix="torchface-blender-") as folder:
        source, made, notes = (Path(folder, name) for name in ("rig.usdc", f"made{path.suffix.lower()}", "notes.json"))
        write_usd_rig(plain, source, keys)
        notes.write_text(json.dumps(_notes(rig, names, keys)))
        seconds = _SECONDS_ALWAYS + _SECONDS_A_MEGABYTE * source.stat().st_size / 2**20
        said = run_process([*command, str(source), str(made), str(notes)], f"{path}", "Blender", seconds)
        if not made.is_file():
            raise FileFormatError(f"{path}: cannot be written: Blender wrote nothing{said}")
        with replaced_file(path) as temporary:
            shutil.copyfile(made, temporary)


def _notes(rig: BlendshapeRig, names: tuple[str, ...], keys: WeightKeys | None) -> dict[str, Any]:
    """What Blender gets beside the USD file; see ``writing_in_blender.py``."""
    ranges = torch.tensor([0.0, 1.0]).repeat(len(names), 1)
    if keys is not None:  # Blender holds weights to what the sliders show
        ranges = torch.stack([keys.weights.amin(0).clamp(max=0), keys.weights.amax(0).clamp(min=1)], 1)
    correctives = []
    if (activation := rig.activation) is not None:
        records = zip(activation.records(), activation.expressions(), strict=True)
        correctives = [record | {"expression": expression} for record, expression in records]
    return {
        "fps": 24.0 if keys is None else keys.fps,
        "names": names,
        "ranges": ranges.tolist(),
        "correctives": correctives,
    }

"""``torchface convert``: a rig with its animation, or a mesh, as another kind of file."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchface.cli.command_options import OutputPath, Reduce
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, console, print_lines, print_path


def convert(
    source: Annotated[Positional[Path], arg(metavar="FILE")],
    out: Positional[OutputPath],
    unit: str | None = None,
    part: str | None = None,
    names: Literal["arkit"] | None = None,
    at: tuple[str, ...] = (),
    reduce: Reduce = None,
    quiet: Quiet = False,
) -> None:
    """Write a rig with its animation, or a mesh, as another kind of file, FBX and Blender's own among them.

    FBX and Blender files go through Blender in a process of its own: the program, or its package bpy
    (torchface's extra `blender`, Python 3.11); TORCHFACE_BLENDER names the one to take, or a Python with bpy.

    Args:
        source: A rig (.glb, .gltf, USD, .fbx, .blend, a folder of OBJ files, ICT-FaceKit's FaceXModel folder) or a mesh
            (.obj, .ply, .stl, .off).
        out: .glb, .usda, .usdc, .usd, .usdz, .ma (Maya), .fbx, .blend, or a name without an ending for a folder of OBJ
            files; a mesh without shapes, or in a pose, also as .obj, .ply, .stl, .off. May be given as --out OUT.
        unit: Unit of FILE (um, mm, cm, m, in) where it is not the format's own.
        part: Keep this region only, such as face.
        names: Names of the written shapes. "arkit": ARKit's where the rig's mean the same. All keep theirs if absent.
        at: Write the mesh in this pose, such as mouthSmileLeft=1 jawOpen=0.7, instead of the rig.
    """
    from torchface.workflows.convert_file import convert_file
    from torchface.workflows.posed_mesh import pose_weights

    with progress_bars(quiet) as progress:
        pose = pose_weights(at, "--at")
        done = convert_file(source, out, unit, part, names, progress, pose, reduce)
    shapes = 0 if done.rig is None else len(done.rig.names)
    frames = "" if done.take is None else f", {len(done.take)} frames at {done.take.rate}"
    console.print(f"{shapes} shapes, {len(done.mesh.vertices):,} vertices{frames}", highlight=False)
    print_lines(done.notes)
    print_path(out)

"""``torchface rig``: an actor's own rig from scans."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from torchface.cli.progress import Quiet, console, print_path, progress_bars


def rig(
    scan: Positional[Path],
    template: Path,
    out: Path,
    landmarks: Path | None = None,
    examples: Path | None = None,
    detail: Path | None = None,
    pose: tuple[str, ...] = (),
    part: str | None = None,
    unit: str | None = None,
    detector: str | None = None,
    model: str | None = None,
    texture_size: int = 2048,
    detail_size: int = 2048,
    names: Literal["arkit"] | None = None,
    quiet: Quiet = False,
) -> None:
    """Make an actor's own rig from raw scans and a template rig, and write it as .glb.

    An image beside it, NAME_registration.png, shows how the neutral scan was met: distances (blue 0 to red 1 mm,
    grey where the scan shows no skin) and the mesh's lines. Hair, cloth and ears in pieces are taken from the template.

    The neutral scan gives the actor's face in the template's topology, deformation transfer its shapes. Scans of
    expressions make the shapes the actor's own; high-resolution scans give normal maps for wrinkles.

    EXAMPLES holds scans (.obj, .ply, .stl, .off, .glb, .gltf). Each file's name says roughly what it shows, as in
    jawOpen.obj or jawOpen=0.6+mouthSmileLeft=0.5.obj; or a file weights.csv in the folder does, with the header
    scan,<shape>,... and a row for each file. Landmark files of the same names (.ljson, .pts, .json) may lie beside the
    scans. DETAIL holds one scan a shape at full strength, named for it, and neutral.obj (or another format).

    Args:
        scan: The actor at rest: any topology and pose, with holes, hair and collar.
        template: A .glb with morph targets, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder.
        out: The .glb to write, or a name without an ending for a folder of OBJ files in the template's vertex order.
        landmarks: The scan's landmarks: .ljson, .pts or .json in the order of the template's annotated landmarks, or
            correspondences saved by `torchface pick`. Without them the face is found by its shape.
        examples: Folder of scans of expressions.
        detail: Folder of high-resolution scans.
        pose: What the neutral scan shows where it is not at rest, such as eyeBlinkLeft=1 eyeBlinkRight=1 for closed
            eyes; the rig's neutral has them open.
        part: Keep this region of the template only, such as face.
        unit: Unit of all scans (mm, cm, m) where it is not the format's own.
        detector: Landmark detector for scans without landmarks, by name or folder; `uv_landmarks` has learned from
            coloured scans with closed eyes. Without it the face is found by its shape.
        model: Model of heads in the template's topology, by name or folder, from which the neutral's registration
            starts; see `python -m train.morphable`.
        texture_size: Texels a side of the rig's texture; 0 makes none.
        detail_size: Texels a side of each normal map.
        names: Names of the written shapes. "arkit": ARKit's where the template's mean the same, halves of one of its
            shapes merged (browInnerUp, cheekPuff); shapes that ARKit lacks keep theirs. All keep theirs if absent.
        quiet: Show no progress.
    """
    from torchface.workflows.posed_mesh import pose_weights
    from torchface.workflows.rig.actor_rig import RigOptions, rig_actor
    from torchface.workflows.rig_names import naming_lines

    options = RigOptions(part, unit, pose_weights(pose), detector, model, texture_size, detail_size, names)
    with progress_bars(quiet) as progress:
        report = rig_actor(scan, template, out, landmarks, examples, detail, options, progress)
    for line in [*report.lines(), *naming_lines(report.rig, names)]:
        console.print(line, highlight=False)
    print_path(out)

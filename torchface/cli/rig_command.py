"""``torchface rig``: an actor's own rig from scans."""

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from torchface.cli.batch_report import Cluster, Column, Jobs, TimeLimit, work_on
from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet, print_lines, print_path

_COLUMNS = (
    Column("median", "median_mm", "{:.3f} mm"),
    Column("95 %", "p95_mm", "{:.2f} mm"),
    Column("on the scan", "shown", "{:.0%}"),
    Column("shapes", "shapes", "{}"),
)


def rig(
    scan: Annotated[Positional[tuple[Path, ...]], arg(metavar="[SCAN...]")] = (),
    *,
    out: OutputPath,
    template: Path | None = None,
    neutral: Path | None = None,
    expressions: str | None = None,
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
    colors: bool = True,
    inner_mouth: bool = False,
    eyes: bool = False,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
) -> None:
    """Make an actor's own rig from raw scans and a template rig, or put ARKit's shapes on a character's face.

    Without --template and --neutral SCAN is a character, a .glb, .vrm or USD file with or without a body. Its face is
    found, in any pose and unit; OUT is the same file with ARKit's shapes on the face and nothing else changed. Shapes
    that it has, by ARKit's or another program's names, are kept; a VRM gets an expression for each. NAME_face.png
    beside OUT shows the face.

    The neutral scan gives the actor's face in the template's topology, deformation transfer its shapes. Scans of
    expressions make the shapes the actor's own; high-resolution scans give normal maps for wrinkles.

    NAME_registration.png beside OUT shows how the neutral scan was met: distances (blue 0 to red 1 mm,
    grey where the scan shows no skin) and the mesh's lines. Hair, cloth and ears in pieces are taken from the template.

    EXAMPLES holds scans (.obj, .ply, .stl, .off, .glb, .gltf). Each file's name says roughly what it shows, as in
    jawOpen.obj or jawOpen=0.6+mouthSmileLeft=0.5.obj; or a file weights.csv in the folder does, with the header
    scan,<shape>,... and a row for each file. Landmark files of the same names (.ljson, .pts, .json) may lie beside the
    scans. DETAIL holds one scan a shape at full strength, named for it, and neutral.obj (or another format).

    A head that has the template's topology already: --neutral HEAD in place of SCAN. A model of expressions, learned
    from other people, predicts its shapes; deformation transfer makes those that the model does not know and those in
    which it is unsure. NAME_shapes/index.html shows both ways side by side.

    Neutral scans of several actors, or a folder of them: OUT is a folder, for NAME.glb of each; --landmarks may be a
    folder of files named as the scans. {name} in an option's path is the
    scan's name. One that cannot be worked on is reported and skipped, and the exit status is 1; started again, the
    command goes on where it was.

    Args:
        scan: The actor at rest: any topology and pose, with holes, hair and collar; one that has the template's
            triangles is taken as it is. Or several actors' scans, or folders of them. Without a template a character's
            file.
        out: The .glb or USD file to write, or a name without an ending for a folder of OBJ files in the template's
            vertex order.
        template: A .glb or USD file with shapes, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder. With
            --neutral the embedded performer if absent.
        neutral: A head at rest in the template's topology, in place of a scan.
        expressions: Model of expressions in the template's topology, by name or folder, see `torchface train
            expression`; it predicts shapes of a scan too. With --neutral the zoo's `expressions` if absent.
        landmarks: The scan's landmarks: .ljson, .pts or .json in the order of the template's annotated landmarks, or
            correspondences saved by `torchface pick`. Without them the face is found by its shape.
        examples: Folder of scans of expressions.
        detail: Folder of high-resolution scans.
        pose: What the neutral scan shows where it is not at rest, such as eyeBlinkLeft=1 eyeBlinkRight=1 for closed
            eyes; the rig's neutral has them open.
        part: Keep this region of the template only, such as face.
        unit: Unit of all scans (um, mm, cm, m, in) where it is not the format's own.
        detector: Landmark detector for scans without landmarks, by name or folder; `uv_landmarks` has learned from
            coloured scans with closed eyes. Without it the face is found by its shape.
        model: Model of heads in the template's topology, by name or folder, from which the neutral's registration
            starts; see `torchface train morphable`.
        texture_size: Texels a side of the rig's texture; 0 makes none.
        detail_size: Texels a side of each normal map.
        names: Names of the written shapes. "arkit": ARKit's where the template's mean the same, halves of one of its
            shapes merged (browInnerUp, cheekPuff); shapes that ARKit lacks keep theirs. All keep theirs if absent.
        colors: Find hair by the scans' colours and keep them. --no-colors where they are not the person's: a map of
            distances or curvature, say.
        inner_mouth: Give a character the inside of a mouth that its mesh lacks: a bag, teeth, gums, a tongue; lips in
            one piece are cut apart.
        eyes: Give a character eyeballs that its mesh lacks; eyes in one piece with the skin are cut out.
    """
    from torchface.errors import ValueRangeError
    from torchface.workflows.batch.batch_items import check_folder, is_batch
    from torchface.workflows.posed_mesh import pose_weights
    from torchface.workflows.rig.actor_job import ACTORS, ActorJob
    from torchface.workflows.rig.actor_rig import RigOptions, rig_actor
    from torchface.workflows.rig.predicted_rig import EXPRESSIONS, predict_rig
    from torchface.workflows.rig_names import naming_lines

    if template is None and neutral is None and scan:
        of_scans: dict[str, object] = {
            "--landmarks": landmarks,
            "--examples": examples,
            "--detail": detail,
            "--expressions": expressions,
        }
        of_scans |= {"--pose": pose or None, "--part": part, "--unit": unit, "--detector": detector, "--model": model}
        _rig_character(
            scan, out, (inner_mouth, eyes), [flag for flag, value in of_scans.items() if value is not None], quiet
        )
        return
    if inner_mouth or eyes:
        raise ValueRangeError("--inner-mouth, --eyes: for a character's file, without --template and --neutral")
    options = RigOptions(
        part, unit, pose_weights(pose, "--pose"), detector, model, texture_size, detail_size, names, colors, expressions
    )
    if neutral is not None:
        unused = [
            flag
            for flag, value in (
                ("SCAN", scan),
                ("--landmarks", landmarks),
                ("--examples", examples),
                ("--detail", detail),
                ("--pose", pose),
                ("--detector", detector),
                ("--model", model),
            )
            if value
        ]
        if unused:
            raise ValueRangeError(f"--neutral: found {', '.join(unused)} beside it, which are for a scan")
        with progress_bars(quiet) as progress:
            made = predict_rig(neutral, out, expressions or EXPRESSIONS, template, options, progress)
        print_lines([*made.lines(), *naming_lines(made.made.rig, names)])
        print_path(out)
        return
    if not scan or template is None:
        raise ValueRangeError("rig: expected a SCAN and --template RIG, or --neutral HEAD in the template's topology")
    if cluster is not None or is_batch(scan, ACTORS):
        check_folder(out)
        job = ActorJob(template, landmarks, examples, detail, options)
        work_on(job, ACTORS, scan, out, (jobs, cluster, time_limit), _COLUMNS, "median_mm", quiet)
        return
    with progress_bars(quiet) as progress:
        report = rig_actor(scan[0], template, out, landmarks, examples, detail, options, progress)
    print_lines([*report.lines(), *naming_lines(report.rig, names)])
    print_path(out)


def _rig_character(scan: tuple[Path, ...], out: Path, parts: tuple[bool, bool], given: list[str], quiet: bool) -> None:
    from torchface.errors import ValueRangeError
    from torchface.workflows.rig.character_rig import check_character, rig_character
    from torchface.workflows.rig.usd_character import USD_ENDINGS, rig_usd_character

    if given or len(scan) > 1:
        found = " and ".join(given) or f"{len(scan)} files"
        raise ValueRangeError(
            f"found {found} without --template, expected one for scans, or one character's file alone"
        )
    usd = scan[0].suffix.lower() in USD_ENDINGS
    if usd and any(parts):
        raise ValueRangeError("--inner-mouth, --eyes: for a .glb or .vrm, found a USD file; export it as .glb")
    if not usd:
        check_character(scan[0])
    with progress_bars(quiet) as progress:
        report = (
            rig_usd_character(scan[0], out, progress)
            if usd
            else rig_character(scan[0], out, progress, inner_mouth=parts[0], eyes=parts[1])
        )
    print_lines(report.lines())
    if report.figure is not None:
        print_path(report.figure)
    print_path(out)

"""``torchface register``: a template bent onto many scans."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from torchface.cli.batch_report import Cluster, Column, Jobs, TimeLimit, show_batch, skipped_lines
from torchface.cli.command_options import OutputPath
from torchface.cli.progress_bars import progress_bars
from torchface.cli.terminal import Quiet


def register(
    template: Positional[Path],
    scans: Annotated[Positional[tuple[Path, ...]], arg(metavar="SCAN...")],
    out: OutputPath,
    landmarks: Path | None = None,
    part: str | None = None,
    unit: str | None = None,
    detector: str | None = None,
    texture_size: int = 1024,
    model: str | None = None,
    colors: bool = True,
    jobs: Jobs = 1,
    cluster: Cluster = None,
    time_limit: TimeLimit = None,
    quiet: Quiet = False,
) -> None:
    """Bend a template onto raw scans: each scan's face in the template's topology, with the scan's colours.

    Writes OUT/NAME.glb and a record OUT/records/NAME.json for each scan, OUT/summary.csv and OUT/contact_sheet.png,
    which shows each face, its mesh's lines and its distances to the scan (blue 0 to red 1 mm, grey where the scan shows
    no skin).
    A scan that cannot be registered is reported and skipped, and the exit status is 1. Killed and started again, the
    command goes on where it was; a scan whose files have changed is registered anew.

    Args:
        template: A mesh or rig: .glb, USD, .obj, .ply, .stl, .off, a folder of OBJ files, or ICT-FaceKit's FaceXModel
            folder.
        scans: Files (.obj, .ply, .stl, .off, .glb, .gltf, USD), or folders of them.
        out: The folder to write into.
        landmarks: Folder of landmark files named as the scans are, or the file of the only scan: .ljson, .pts or .json
            in the order of the template's annotated landmarks, or correspondences saved by `torchface pick`.
        part: Keep this region of the template only, such as face.
        unit: Unit of the scans (um, mm, cm, m, in) where it is not the format's own.
        detector: Landmark detector for scans without landmarks, by name or folder; `uv_landmarks` has learned from
            coloured scans with closed eyes. Without it the face is found by its shape.
        texture_size: Texels a side of each result's texture; 0 makes none.
        model: Name or folder of a head model in the template's topology: each registration starts from it, and what it
            knows of heads does not slide along the scan.
        colors: Find hair by the scans' colours and keep them. --no-colors where they are not the people's: a map of
            distances or curvature, say.
    """
    from torchface.files.job_lock import job_lock
    from torchface.registration.nonrigid.schedule import DEFAULT_SCHEDULE
    from torchface.workflows.batch.run_batch import BatchOptions
    from torchface.workflows.register.register_scans import (
        ScanSettings,
        load_shape_model,
        load_template_mesh,
        register_scans,
    )

    with job_lock(out), progress_bars(quiet) as progress:
        heads = None if model is None else load_shape_model(model)
        settings = ScanSettings(landmarks, unit, DEFAULT_SCHEDULE, texture_size, detector, heads, colors)
        done = register_scans(
            load_template_mesh(template, part),
            scans,
            out,
            settings,
            BatchOptions(jobs, cluster, time_limit),
            progress,
            skipped_lines(quiet),
        )
    # The worst first: those are the ones to look at.
    show_batch(
        done,
        (
            Column("median", "median_mm", "{:.3f} mm"),
            Column("95 %", "p95_mm", "{:.2f} mm"),
            Column("on the scan", "shown", "{:.0%}"),
            Column("landmarks", "slid_mm", "{:.1f} mm"),
            Column("start by", "start", "{}"),
        ),
        "median_mm",
        "95 %: distance of the 95th percentile; on the scan: of what faces outward, the rest is the template's; "
        "landmarks: how far the scan's lie from the mesh's own, inside the face (?: the scan has none). Without them "
        "no figure says whether the mesh lies too far to a side on the skin",
    )

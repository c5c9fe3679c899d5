"""``torchface register``: a template bent onto many scans."""

from __future__ import annotations

from math import isnan
from pathlib import Path

from rich.table import Table
from rich.text import Text
from tyro.conf import Positional

from torchface.cli.progress import Quiet, console, print_path, progress_bars

_MAX_ROWS = 40
_NAMED = 3


def register(
    template: Positional[Path],
    scans: Positional[tuple[Path, ...]],
    out: Path,
    landmarks: Path | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    part: str | None = None,
    unit: str | None = None,
    detector: str | None = None,
    texture_size: int = 1024,
    model: str | None = None,
    quiet: Quiet = False,
) -> None:
    """Bend a template onto raw scans: each scan's face in the template's topology, with the scan's colours.

    Writes OUT/NAME.glb and a record OUT/NAME.json for each scan, OUT/summary.csv and OUT/contact_sheet.png, which shows
    each face, its mesh's lines and its distances to the scan (blue 0 to red 1 mm, grey where the scan shows no skin).
    A scan that cannot be registered is reported and skipped. Killed and started again, the command goes on where it
    was; a scan whose files have changed is registered anew.

    Args:
        template: A mesh or rig: .glb, .obj, .ply, .stl, .off, a folder of OBJ files, or ICT-FaceKit's FaceXModel
            folder.
        scans: Files (.obj, .ply, .stl, .off, .glb, .gltf), or folders of them.
        out: The folder to write into.
        landmarks: Folder of landmark files named as the scans are: .ljson, .pts or .json in the order of the
            template's annotated landmarks, or correspondences saved by `torchface pick`.
        jobs: How many processes, of one thread each.
        cluster: Address of a Ray cluster, or "auto" on one of its machines, instead of --jobs; scans and OUT must lie
            where all its machines see them. Needs the extra: pip install '.[cluster]' in a checkout.
        part: Keep this region of the template only, such as face.
        unit: Unit of the scans (mm, cm, m) where it is not the format's own.
        detector: Landmark detector for scans without landmarks, by name or folder; `uv_landmarks` has learned from
            coloured scans with closed eyes. Without it the face is found by its shape.
        texture_size: Texels a side of each result's texture; 0 makes none.
        model: Name or folder of a head model in the template's topology: each registration starts from it, and what it
            knows of heads does not slide along the scan.
        quiet: Show no progress.
    """
    from torchface.registration.corpus.scan_record import CorpusEntry
    from torchface.workflows.register_scans import register_scans

    def tell_skipped(entry: CorpusEntry) -> None:
        if not entry.registered and not quiet:
            console.print(Text("skipped", "yellow"), f"{entry.scan.name}: {entry.error}", highlight=False)

    with progress_bars(quiet) as progress:
        done = register_scans(
            template,
            scans,
            out,
            landmarks,
            jobs,
            cluster,
            part,
            unit,
            detector,
            texture_size,
            model,
            progress,
            tell_skipped,
        )
    entries = done.report.entries
    reused = sum(entry.reused for entry in entries)
    title = f"{len(done.report.registered)} of {len(entries)} scans registered"
    table = Table(title=title + (f", {reused} known from an earlier run" if reused else ""))
    for head in ("scan", "median", "95 %", "on the scan", "slid", "start by", "seconds"):
        table.add_column(head)
    # The worst first: those are the ones to look at.
    ranked = sorted(entries, key=lambda entry: (entry.registered, -entry.median_distance if entry.registered else 0.0))
    for entry in ranked[:_MAX_ROWS]:
        numbers = (
            f"{entry.median_distance:.3f} mm",
            f"{entry.far_distance:.2f} mm",
            f"{entry.shown:.0%}",
            "?" if isnan(entry.slid) else f"{entry.slid:.1f} mm",
        )
        if not entry.registered:
            numbers = ("skipped", "", "", "")
        table.add_row(entry.name, *numbers, entry.start, f"{entry.seconds:.1f}")
    console.print(table)
    console.print(
        "95 %: distance of the 95th percentile; on the scan: of what faces outward, the rest is the template's; slid: "
        "how far landmarks inside the face end from their vertices, unknown without: what slides along the skin "
        "is as near to it as what does not",
        highlight=False,
    )
    remarks: dict[str, list[str]] = {}
    for entry in ranked:
        for remark in entry.notes or ([entry.error] if entry.error else []):
            remarks.setdefault(remark, []).append(entry.name)
    for remark, names in list(remarks.items())[:_MAX_ROWS]:
        who = ", ".join(names) if len(names) <= _NAMED else f"{len(names)} of {len(entries)} scans"
        console.print(f"{who}: {remark}", highlight=False)
    if len(entries) > _MAX_ROWS:
        console.print(f"the {_MAX_ROWS} worst; all are in {done.report.summary}")
    print_path(done.report.summary)
    print_path(done.contact_sheet)

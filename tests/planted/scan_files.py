"""Folders of raw scans with the truth beside them."""

from collections.abc import Iterable
from pathlib import Path

from torchface import Mesh, save_mesh
from torchface.files.documents import write_json
from torchface.files.whole_files import all_or_none, made_folder
from torchface.synthetic.stages import RawScan, ScannerSettings, scan_head

_MENPO_GROUPS = (
    ("chin", range(17)),
    ("leyebrow", range(17, 22)),
    ("reyebrow", range(22, 27)),
    ("nose", range(27, 36)),
    ("leye", range(36, 42)),
    ("reye", range(42, 48)),
    ("mouth", range(48, 68)),
)


def write_scan(scan: RawScan, folder: str | Path, name: str) -> Path:
    """Writes ``name.obj`` with its material and image, and ``name.ljson`` with the 68 landmarks, as menpo does.

    Returns:
        The path of the OBJ file.
    """
    folder = Path(folder)
    groups = [{"label": label, "mask": list(rows)} for label, rows in _MENPO_GROUPS]
    landmarks = {"points": scan.ibug.tolist(), "connectivity": []}
    document = {"version": 2, "labels": groups, "landmarks": landmarks}
    with made_folder(folder), all_or_none():
        write_json(folder / f"{name}.ljson", document, indent=None)
        save_mesh(scan.mesh, folder / f"{name}.obj")
    return folder / f"{name}.obj"


def write_scans(
    heads: Iterable[Mesh], folder: str | Path, settings: ScannerSettings | None = None, seed: int = 0
) -> list[Path]:
    """Scans heads one by one into a folder: ``scan_000.obj`` and so on, and ``annotations.json`` with the truth.

    Returns:
        The paths of the OBJ files.
    """
    paths, scans = [], {}
    for i, head in enumerate(heads):
        scan = scan_head(head, seed + i, settings)
        paths.append(write_scan(scan, folder, f"scan_{i:03d}"))
        parts = {"points": scan.annotation.points, "lines": scan.annotation.lines}
        scans[paths[-1].name] = {
            part: {name: value.tolist() for name, value in values.items()} for part, values in parts.items()
        }
    document = {"format": "torchface.scan-annotations/1", "unit": "mm", "scans": scans}
    write_json(Path(folder) / "annotations.json", document)
    return paths

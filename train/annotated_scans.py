"""Raw scans and what is known of them: a user's own, or scanned performers."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath

import torch

from torchface import Mesh, load_mesh
from torchface.landmarks import ScanAnnotation, load_annotations
from torchface.progress import Progress, silent
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.stages import ScannerSettings, eyes_closed, scan_head

_VOXEL = 1.7  # millimetres; coarse, and so a scan takes seconds


@dataclass(frozen=True, eq=False)
class AnnotatedScan:
    """A scan, what is known of it, and what to call it."""

    name: str
    mesh: Mesh
    truth: ScanAnnotation


def annotated_scans(folder: Path, annotations: Path) -> list[AnnotatedScan]:
    """The scans of a folder that are annotated, by name."""
    known = load_annotations(annotations)
    return [AnnotatedScan(name, load_mesh(folder / name), known[name]) for name in sorted(known)]


def shown_people(names: Sequence[str]) -> list[str]:
    """Whom scans show: those of one folder the same person, others each a person of its own."""
    return [str(PurePath(name).parent) if len(PurePath(name).parts) > 1 else name for name in names]


def scanned_performers(count: int, seed: int, progress: Progress | None = None) -> list[AnnotatedScan]:
    """Raw textured scans of embedded performers with closed eyes, and the truth about them."""
    progress = progress or silent
    settings, scans = ScannerSettings(voxel=_VOXEL), []
    for i, identity in enumerate(draw_identities(count, torch.Generator().manual_seed(seed))):
        scan = scan_head(eyes_closed(performer(identity)), 1000 * seed + i, settings)
        scans.append(AnnotatedScan(f"performer {i:03d}", scan.mesh, scan.annotation))
        progress("scanning performers", i + 1, count)
    return scans

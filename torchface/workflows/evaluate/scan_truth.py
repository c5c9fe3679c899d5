"""Raw scans as the truth: each registered to the result's topology, and kept to measure the distance to its surface."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import AlignmentError, TopologyError
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.rotations import rotation_matrix
from torchface.io import load_mesh
from torchface.progress import Progress
from torchface.workflows.animated_meshes import AnimatedMesh
from torchface.workflows.register.register_scans import ScanSettings, register_scans

NEAR = 2.0
"""Millimetres; a vertex that came to lie further from the scan, or on its border, only followed its neighbours."""
_MIN_VERTICES, _MAX_ITERATIONS = 12, 20


@dataclass(frozen=True, eq=False)
class ScanTruth:
    """Scans, and the meshes registered to them."""

    animated: AnimatedMesh  # the registered meshes, a frame each; NaN where the scan does not show a vertex
    scans: tuple[Path, ...]
    unit: str | None
    notes: tuple[str, ...]  # what there is to say of each

    def surface_errors(self, begin: int, vertices: Tensor) -> Tensor:
        """Distances (t,V) from vertices (t,V,3) of the frames from ``begin`` on to the scans' surfaces; NaN where the
        scan does not show the vertex."""
        distances = torch.full(vertices.shape[:2], torch.nan)
        for row, (usable, surface) in enumerate(self._surfaces(begin, vertices)):
            distances[row, usable] = surface.nearest(vertices[row, usable]).distance.to(distances)
        return distances

    def settled(self, begin: int, vertices: Tensor) -> Tensor:
        """Vertices (t,V,3) of the frames from ``begin`` on, moved rigidly to where they lie best on the scans'
        surfaces, by iterated closest points from where they are.

        A registered mesh places a vertex along the surface only as exactly as registration does; this asks
        nothing of it.
        """
        moved = vertices.clone()
        for row, (usable, surface) in enumerate(self._surfaces(begin, vertices)):
            if int(usable.sum()) >= _MIN_VERTICES:
                moved[row] = settled_on(surface, vertices[row], usable)
        return moved

    def _surfaces(self, begin: int, vertices: Tensor) -> Iterator[tuple[Tensor, SurfaceIndex]]:
        shown = torch.isfinite(self.animated.read(begin, begin + len(vertices))).all(2)
        for row, file in enumerate(self.scans[begin : begin + len(vertices)]):  # a surface of its own each
            scan = load_mesh(file, self.unit)
            yield shown[row] & torch.isfinite(vertices[row]).all(1), SurfaceIndex(scan.vertices, scan.faces)


def settled_on(surface: SurfaceIndex, vertices: Tensor, usable: Tensor) -> Tensor:
    r"""Vertices (V,3) moved rigidly to where those of a mask (V,) lie best on a surface.

    .. math:: \min_{R,t} \sum_i \left( n_i \cdot (R x_i + t - y_i) \right)^2

    over the nearest points :math:`y_i` and their normals :math:`n_i`, found again in each iteration.

    Source: Chen and Medioni 1992.
    """
    moved = vertices.double()
    for _ in range(_MAX_ITERATIONS):  # each iteration looks for other nearest points
        points = moved[usable]
        nearest = surface.nearest(points)
        normals = surface.normals_at(nearest)
        centre = points.mean(0)
        # Small rotations about the points' centre: n · (r × x) = r · (x × n).
        system = torch.cat([torch.linalg.cross(points - centre, normals), normals], dim=1)
        wanted = ((nearest.points - points) * normals).sum(1)
        # A motion that the surface does not determine (the rotation of a sphere) stays zero.
        step = torch.linalg.lstsq(system, wanted, driver="gelsd", rcond=1e-6).solution
        moved = (moved - centre) @ rotation_matrix(step[:3]).T + centre + step[3:]
        if float(step[:3].norm()) < 1e-6 and float(step[3:].norm()) < 1e-4:
            break
    return moved.to(vertices)


def scan_truth(
    result: AnimatedMesh,
    scans: Sequence[Path],
    out: Path,
    landmarks: Path | None = None,
    unit: str | None = None,
    progress: Progress | None = None,
) -> ScanTruth:
    """Registers scans; those that ``out`` holds from an earlier run are taken as they are.

    Args:
        result: what they are the truth of; its face at rest is what is bent.
        landmarks: a folder of landmark files named as the scans.
    """
    if result.rig is None:
        raise TopologyError(
            f"{result.path}: found meshes without a rig, expected the rig whose neutral the scans are of (--rig)"
        )
    settings = ScanSettings(landmarks, unit, texture_size=0)
    report = register_scans(result.neutral, scans, out, settings, progress=progress)
    lost = report.skipped
    if lost:
        raise AlignmentError(
            f"{lost[0].item.path}: could not be registered ({lost[0].error}), expected a scan of the face"
        )
    frames, notes = [], []
    for outcome in report.outcomes:  # a surface of its own each
        vertices = load_mesh(outcome.results[0]).vertices
        scan = load_mesh(outcome.item.path, unit)
        index = SurfaceIndex(scan.vertices, scan.faces)
        nearest = index.nearest(vertices)
        shown = (nearest.distance <= NEAR) & ~index.on_border(nearest)
        frames.append(torch.where(shown[:, None], vertices, torch.nan))
        known = "" if not outcome.reused else ", known from an earlier run"
        notes.append(
            f"{outcome.name}: registered by {outcome.figures['start']}, median {outcome.figures['median_mm']:.3f} mm "
            f"from the scan, which shows {float(shown.float().mean()):.0%} of the vertices{known}"
        )
    stacked = torch.stack(frames)
    name = scans[0] if len(scans) == 1 else out
    animated = AnimatedMesh(Path(name), result.neutral, len(frames), lambda begin, end: stacked[begin:end])
    return ScanTruth(animated, tuple(outcome.item.path for outcome in report.outcomes), unit, tuple(notes))

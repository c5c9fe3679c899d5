"""Claim: the twelve landmarks found by themselves bring lips and lids nearer to the truth than no landmarks, and the
traced lines bring the lids nearer still (the thesis's figures 12 and 14). The face as a whole they do not.

The embedded head, its eyes open, is registered to raw scans of performers with closed eyes, of whom every vertex's true
place is known. ``$TORCHFACE_BENCH_HEADS`` sets how many scans (6 if absent).
"""

import os
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface import Mesh, zoo
from torchface.errors import NameMismatchError
from torchface.landmarks import (
    UV_LANDMARK_NAMES,
    AutomaticLandmarks,
    LandmarkPairs,
    UVLandmarkDetector,
    scan_landmarks,
)
from torchface.landmarks.scans.landmark_pairs import scan_pairs, template_features
from torchface.registration import register
from torchface.registration.scan_preparation import Landmarks
from torchface.rendering.compositing import headed, save_rendered_image, sheet
from torchface.synthetic import draw_identities, neutral_head, performer
from torchface.synthetic.stages.scanner import RawScan, ScannerSettings, eyes_closed, scan_head
from torchface.synthetic.stages.subdivision import finely_coloured
from torchface.viz.figures.face_views import heat_map
from train.annotated_scans import scanned_performers
from train.uv_landmarks import fit

SCANS = int(os.environ.get("TORCHFACE_BENCH_HEADS", "6"))
PICTURE = Path("out/landmarks/ablation.png")
SCANNER = ScannerSettings(voxel=1.7)
SURE = 0.01


@dataclass(frozen=True)
class Case:
    scan: RawScan
    truth: Tensor


def case(seed: int) -> Case:
    """A scan, and where each vertex of the head is on it."""
    closed = eyes_closed(performer(draw_identities(1, torch.Generator().manual_seed(seed))[0]))
    scan = scan_head(closed, seed, SCANNER)
    smooth = finely_coloured(closed, SCANNER.detail).vertices[: len(closed.vertices)]
    return Case(scan, smooth.double() @ scan.rotation.T + scan.translation)


@pytest.fixture(scope="module")
def detector() -> UVLandmarkDetector:
    try:
        return zoo.get_model("uv_landmarks")
    except NameMismatchError:
        return fit(scanned_performers(30, seed=7))


def some(pairs: LandmarkPairs, names: tuple[str, ...]) -> Landmarks:
    rows = torch.tensor([i for i, name in enumerate(pairs.names) if name in names])
    return pairs.vertices[rows], pairs.points[rows]


Table = dict[str, dict[str, float]]


@pytest.fixture(scope="module")
def table(detector: UVLandmarkDetector) -> Table:
    """Mean distance of each part of the face to its true place, millimetres, by the landmarks that were used."""
    template = neutral_head(texture=False)
    finder = AutomaticLandmarks(detector, template)
    regions, contacts = template.annotations.regions, template.annotations.contacts.flatten()
    lids, lips = regions["lids_left"] | regions["lids_right"], regions["upper_lip"] | regions["lower_lip"]
    edge = torch.zeros_like(lids)
    edge[contacts] = True
    parts = {
        "face": regions["face"],
        "lids": lids,
        "lips": lips,
        "lid edges": edge & (template.vertices[:, 1] > template.vertices[template.landmarks[33], 1]),
        "lip edges": edge & (template.vertices[:, 1] < template.vertices[template.landmarks[33], 1]),
    }
    errors: dict[str, list[Tensor]] = {}
    for seed in range(300, 300 + SCANS):
        made = case(seed)
        pairs = scan_pairs(
            template_features(template, detector), scan_landmarks(detector, made.scan.mesh), made.scan.mesh
        ).above(SURE)
        ways: dict[str, Landmarks | None] = {"none": None, "twelve": some(pairs, UV_LANDMARK_NAMES)}
        ways["twelve, lines"] = (pairs.vertices, pairs.points)
        for name, landmarks in ways.items():
            found = register(template, made.scan.mesh, landmarks, texture_size=0).mesh.vertices.double()
            errors.setdefault(name, []).append((found - made.truth).norm(dim=1))
        found = register(template, made.scan.mesh, detector=finder, texture_size=0).mesh.vertices.double()
        errors.setdefault("by itself", []).append((found - made.truth).norm(dim=1))
    mean = {way: torch.stack(each).mean(0) for way, each in errors.items()}
    print(f"\nmean distance to the true place over {SCANS} scans, millimetres")
    print(f"{'landmarks':16}" + "".join(f"{part:>12}" for part in parts))
    told = {way: {part: float(error[rows].mean()) for part, rows in parts.items()} for way, error in mean.items()}
    for way, row in told.items():
        print(f"{way:16}" + "".join(f"{value:12.2f}" for value in row.values()))
    save_rendered_image(sheet([heated(template, error, way) for way, error in mean.items()], 1), PICTURE)
    return told


def test_twelve_landmarks_help_lips_and_lids(table: Table) -> None:
    for part, share in (("lids", 0.99), ("lid edges", 0.99), ("lips", 0.63), ("lip edges", 0.68)):
        assert table["twelve"][part] <= share * table["none"][part]


@pytest.mark.parametrize("way", ["twelve, lines", "by itself"])
def test_traced_lines_help_lids(table: Table, way: str) -> None:
    for part, share in (("lids", 0.63), ("lid edges", 0.55)):
        assert table[way][part] <= share * table["twelve"][part]
    # Lips touch behind the furrow that a scan shows, a millimetre or so; the line pulls them out by some of that.
    assert table[way]["lips"] <= table["none"]["lips"] + 0.15


@pytest.mark.xfail(strict=True, reason="1.32 and 1.52 mm from the true place with landmarks, 1.27 mm without")
@pytest.mark.parametrize("way", ["twelve", "twelve, lines", "by itself"])
def test_landmarks_help_the_face_as_a_whole(table: Table, way: str) -> None:
    assert table[way]["face"] <= table["none"]["face"]


def heated(template: Mesh, error: Tensor, title: str) -> Tensor:
    return headed(heat_map(template, error, 4.0, "mm to the true place"), title)

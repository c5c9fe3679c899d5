"""A real scan met by ICT-FaceKit's face, with its landmarks and without any: how near."""

from pathlib import Path

import pytest

from torchface.io import load_identity_modes, load_landmark_points, load_mesh
from torchface.registration import register

PARTS = {"brows": slice(17, 27), "nose": slice(27, 36), "eyes": slice(36, 48), "mouth": slice(48, 68)}


@pytest.mark.real
def test_a_real_scan_with_landmarks_and_without(data: Path, ict_folder: Path) -> None:
    template = load_identity_modes(ict_folder, count=1, part="face").neutral
    scan = load_mesh(data / "scans" / "james" / "james.obj")
    points = load_landmark_points(data / "scans" / "james" / "james.ljson").ibug()
    face = template.annotations.regions["narrow_face"]
    print(f"\n{'':>14}{'median mm':>11}{'mean':>8}{'95th':>8}{'on the scan':>13}{'s':>7}" + f"{'landmarks, mm:':>16}")
    shares = []
    for name, given in (("landmarks", (template.landmarks, points)), ("none", None)):
        result = register(template, scan, given)
        distance = result.distance[face]
        off = (result.mesh.vertices[template.landmarks].double() - points).norm(dim=1)
        told = ", ".join(f"{part} {float(off[rows].mean()):.1f}" for part, rows in PARTS.items())
        print(
            f"{name:>14}{float(distance.median()):11.3f}{float(distance.mean()):8.3f}{float(distance.quantile(0.95)):8.3f}"
            f"{result.record.matched:13.0%}{result.record.seconds:7.1f}  {told}"
        )
        assert float(distance.median()) <= 0.07
        shares.append(result.record.shown)
        print(f"{'':>14}{result.record.figures()}")
    # Landmarks that disagree with the surface must not take the template off it.
    assert shares[0] >= shares[1] - 0.01

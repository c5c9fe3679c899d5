"""Landmarks along the jaw that lie elsewhere than their vertices: they let go, and it is said."""

from dataclasses import replace

import pytest
import torch

from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Annotations, Mesh
from torchface.registration import register
from torchface.synthetic.head.performer import performer


@pytest.fixture(scope="module")
def annotated(mask: Mesh) -> Mesh:
    """The mask with 68 landmarks: 17 near the rim on both sides and below, the rest spread inside."""
    x, y = mask.vertices[:, 0], mask.vertices[:, 1]
    angle = torch.linspace(0, torch.pi, 17, dtype=torch.float64)
    outline = torch.stack([-62 * angle.cos(), -90 * angle.sin()], dim=-1)
    inner = torch.cartesian_prod(torch.linspace(-40, 40, 9), torch.linspace(-50, 60, 6)).double()[:51]
    places = torch.cat([outline, inner])
    ids = torch.cdist(places, torch.stack([x, y], dim=-1).double()).argmin(1)
    return replace(mask, annotations=Annotations(landmarks=ids))


def test_a_jaw_that_is_drawn_elsewhere_spoils_nothing(annotated: Mesh, warp, rescanned) -> None:
    truth = warp(annotated.vertices)
    scan = rescanned(annotated.with_vertices(truth))
    points = truth[annotated.landmarks].clone()
    # The outline is drawn 14 mm further up the cheek, on the surface.
    slid = points[:17] + torch.tensor([0.0, 14.0, 0.0], dtype=torch.float64)
    points[:17] = SurfaceIndex(scan.vertices, scan.faces).nearest(slid).points
    found = register(annotated, scan, (annotated.landmarks, points))
    inner = register(annotated, scan, (annotated.landmarks[17:], truth[annotated.landmarks[17:]]))

    def error(result) -> float:
        return float((result.mesh.vertices - truth).norm(dim=1).mean())

    assert error(found) < 1.1 * error(inner)
    (note,) = (note for note in found.record.notes if "disagree" in note)
    assert "17 of 17 along the jaw" in note
    assert "inside the face" not in note
    assert not any("disagree" in note for note in inner.record.notes)


def test_a_jaw_that_is_drawn_right_still_leads(annotated: Mesh, warp, rescanned) -> None:
    truth = warp(annotated.vertices)
    scan = rescanned(annotated.with_vertices(truth))
    points = truth[annotated.landmarks]
    found = register(annotated, scan, (annotated.landmarks, points))
    assert float((found.mesh.vertices - truth)[annotated.landmarks[:17]].norm(dim=1).mean()) < 0.5
    assert not any("disagree" in note for note in found.record.notes)


def test_the_surface_has_the_last_word_on_the_nose() -> None:
    """Landmarks a millimetre beside their places, and the nose's tip 8 mm: it lies where the surface has it."""
    template = performer(texture=False).neutral
    somebody = performer(torch.randn(39, generator=torch.Generator().manual_seed(2)), texture=False).neutral
    truth, marks = somebody.vertices.double(), template.landmarks
    points = truth[marks] + torch.randn(68, 3, generator=torch.Generator().manual_seed(0)).double() / 3**0.5
    points[30, 0] += 8.0
    found = register(template, Mesh(truth, somebody.faces), (marks, points), texture_size=0)
    off = (found.mesh.vertices.double() - truth).norm(dim=1)
    assert float(off[marks[30]]) < 2.0
    assert float(off[marks[27:36]].mean()) < 0.8
    (note,) = (note for note in found.record.notes if "disagree" in note)
    assert "1 of 51 inside the face (30) by" in note

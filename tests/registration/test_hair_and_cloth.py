"""Hair and ears in pieces: left out of the registration, form and colours there are the template's."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.registration import DEFAULT_SCHEDULE, Registration, Schedule, register
from torchface.registration.hair_and_cloth import find_ears
from torchface.registration.scan_colors import without_colors
from torchface.registration.scan_completion import completed_colors, completed_form
from torchface.synthetic import performer

SKIN, HAIR = (0.75, 0.55, 0.45), (0.05, 0.04, 0.03)
LIFT = 9.0


@pytest.fixture(scope="module")
def head() -> Mesh:
    neutral = performer().neutral
    return replace(neutral, colors=None, texture=None)


@pytest.fixture(scope="module")
def region(head: Mesh) -> dict[str, Tensor]:
    return head.annotations.regions


@pytest.fixture(scope="module")
def truth(head: Mesh) -> Tensor:
    """A narrower, longer head."""
    return head.vertices.double() * torch.tensor([0.96, 1.05, 1.0], dtype=torch.float64)


@pytest.fixture(scope="module")
def haired(head: Mesh, truth: Tensor, region: dict[str, Tensor]) -> Registration:
    """Registered to the head with curls over the cranium and a left ear of which shreds are left."""
    hair = region["cranium"]
    curls = LIFT + 3 * (truth / 6).sin().sum(1)
    vertices = truth + (hair * curls)[:, None] * vertex_normals(truth, head.faces)
    colors = torch.where(hair[:, None], torch.tensor(HAIR), torch.tensor(SKIN))
    ear = region["ear_left"]
    shreds = (truth * torch.tensor([0.0, 0.7, 0.9], dtype=torch.float64)).sin().sum(1) > -0.7
    kept = ~(ear & shreds)[head.faces].any(-1)
    scan = Mesh(vertices, head.faces[kept], colors=colors)
    return register(head, scan, (head.landmarks, vertices[head.landmarks]), texture_size=0)


def test_hair_is_no_skull(haired: Registration, truth: Tensor, region: dict[str, Tensor]) -> None:
    error = (haired.mesh.vertices.double() - truth).norm(dim=1)
    assert float(error[region["cranium"]].mean()) < 0.4 * LIFT
    assert float(error[region["cheek_left"] | region["cheek_right"] | region["nose"]].mean()) < 1.0
    assert float(haired.matched[region["cranium"]].double().mean()) < 0.05


def test_hair_is_not_painted_on_the_skull(haired: Registration, region: dict[str, Tensor]) -> None:
    colors = haired.mesh.colors
    assert float((colors[region["cranium"]] - torch.tensor(SKIN)).norm(dim=1).quantile(0.95)) < 0.1
    assert not any("colours" in note for note in haired.record.notes)


def rainbow(values: Tensor) -> Tensor:
    """Red to blue over green, as MeshLab paints a quantity, (V,3)."""
    share = (values - values.min()) / (values.max() - values.min())
    return torch.stack([1.5 - (4 * share - at).abs() for at in (3, 2, 1)], 1).clamp(0, 1).float()


def quickly(head: Mesh, scan: Mesh) -> Registration:
    schedule = Schedule(DEFAULT_SCHEDULE.stages[:2])
    return register(head, scan, (head.landmarks, scan.vertices[head.landmarks]), schedule=schedule, texture_size=0)


@pytest.fixture(scope="module")
def bare(head: Mesh, truth: Tensor) -> Registration:
    return quickly(head, without_colors(Mesh(truth, head.faces, colors=rainbow(truth[:, 0]))))


@pytest.mark.parametrize("axis", [0, pytest.param(1, marks=pytest.mark.bench)])
def test_colours_that_no_skin_has_say_nothing_of_hair(head: Mesh, truth: Tensor, bare: Registration, axis: int) -> None:
    painted = quickly(head, Mesh(truth, head.faces, colors=rainbow(truth[:, axis])))
    assert painted.record.covered < 0.01
    assert any("colours are not a face's" in note for note in painted.record.notes)
    torch.testing.assert_close(painted.mesh.vertices, bare.mesh.vertices)
    assert bare.mesh.colors is None


def test_an_ear_in_pieces_is_the_templates(
    haired: Registration, head: Mesh, truth: Tensor, region: dict[str, Tensor]
) -> None:
    left = region["ear_left"]
    assert float(haired.matched[left].double().mean()) < 0.01  # where it grows from the cheek
    # No flakes: its edges are as long as the template's.
    inside = head.faces[left[head.faces].all(-1)]

    def lengths(vertices: Tensor) -> Tensor:
        return (vertices[inside] - vertices[inside.roll(1, 1)]).norm(dim=-1)

    ratio = lengths(haired.mesh.vertices.double()) / lengths(truth)
    assert 0.8 < float(ratio.quantile(0.02)) < float(ratio.quantile(0.98)) < 1.25


def test_ears_are_found_where_they_are_annotated(head: Mesh, region: dict[str, Tensor]) -> None:
    ears = find_ears(head)
    assert len(ears) == 2
    for name in ("ear_left", "ear_right"):
        shares = [float(ear[region[name]].double().mean()) for ear in ears]
        assert max(shares) > 0.85  # the front of the ear grows from the cheek and is not thin
        assert min(shares) == 0.0
    assert find_ears(replace(head, annotations=None)) == []


def test_form_goes_on_as_the_template_does(mask: Mesh) -> None:
    rest = mask.vertices
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64))[0]
    pose = Similarity(torch.tensor([1.1]), (turn * torch.linalg.det(turn))[None], torch.tensor([[5.0, 6.0, 7.0]]))
    truth = pose.apply(rest)[0]
    unseen = rest[:, 1] > 40
    torn = torch.where(unseen[:, None], truth + 30.0, truth)
    found, hidden = completed_form(rest, torn, mask.faces, unseen, ~unseen, ~unseen)
    assert torch.equal(hidden, unseen)
    assert float((found - truth).abs().max()) < 1e-4
    assert torch.equal(found[~unseen], truth[~unseen])


def test_form_bends_on_without_an_edge(mask: Mesh) -> None:
    rest = mask.vertices
    bent = rest + torch.stack([0 * rest[:, 0], 0 * rest[:, 1], 0.0008 * (rest[:, 1] + 110).square()], dim=-1)
    unseen = rest[:, 1] > 60
    found, _ = completed_form(rest, torch.where(unseen[:, None], rest, bent), mask.faces, unseen, ~unseen, ~unseen)
    normals, smooth = vertex_normals(found, mask.faces), vertex_normals(bent, mask.faces)
    near = (rest[:, 1] - 60).abs() < 12
    angle = torch.rad2deg((normals * smooth).sum(-1).clamp(-1, 1).acos())
    assert float(angle[near].max()) < 5.0


def test_form_ignores_vertices_that_hair_moved(mask: Mesh) -> None:
    rest, unseen = mask.vertices, mask.vertices[:, 1] > 60
    hair = ~unseen & (rest[:, 1] > 52) & (rest[:, 0] > 0)
    lifted = rest + 7.0 * hair[:, None] * torch.tensor([0.0, 0.0, 1.0], dtype=rest.dtype)
    found, hidden = completed_form(rest, lifted, mask.faces, unseen, ~unseen, ~unseen)
    assert torch.equal(hidden, unseen | hair)
    assert float((found - rest).norm(dim=1).max()) < 0.5  # a similarity of the few lifted ones
    found, hidden = completed_form(rest, lifted, mask.faces, unseen, ~unseen, torch.zeros_like(unseen))
    assert torch.equal(hidden, unseen)  # without hair it is the person's
    assert torch.equal(found[~unseen], lifted[~unseen])


def test_colors_go_over_into_the_base(mask: Mesh) -> None:
    unseen = mask.vertices[:, 1] > 0
    colors = torch.where(unseen[:, None], 0.0, torch.tensor([0.8, 0.6, 0.5]))
    base = torch.full_like(colors, 0.3)
    found = completed_colors(colors, base, mask.vertices, mask.faces, unseen)
    assert torch.equal(found[~unseen], colors[~unseen])
    height = mask.vertices[:, 1]
    assert float((found - colors.amax(0))[(height > 0) & (height < 6)].abs().max()) < 0.12
    assert float((found - base)[height > 100].abs().max()) < 0.08

"""A mouth that is shut in the template: it comes out shut where the scan shows it shut, and open where it is open."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.mesh import Annotations, Mesh
from torchface.registration import DEFAULT_SCHEDULE, Registration, register
from torchface.registration.nonrigid.lip_contact import contact_pull
from torchface.rendering.raycast import RayCaster

COLUMNS, SKIN, INSIDE = 41, 22, 5
HALF = SKIN + INSIDE


def mouth(gap: float, bulge: float = 0.0) -> Tensor:
    """A face-sized shell cut by lips, rows from the chin up: skin, inside of the lower lip, of the upper one, skin."""
    x = torch.linspace(-70, 70, COLUMNS, dtype=torch.float64)
    width = (1 - (x / 30).square()).clamp(min=0).sqrt()
    up = torch.linspace(0, 1, SKIN, dtype=torch.float64)
    rows = []
    for side in (-1, 1):
        skin = torch.stack([x.expand(SKIN, -1), side * (90 * (1 - up))[:, None].expand(-1, COLUMNS)], dim=-1)
        skin[..., 1] = skin[..., 1] + side * (0.5 * gap * width) * up[:, None]
        lips = (6 + bulge) * torch.exp(-((skin[..., 1] / 9).square())) * width
        crease = -3 * torch.exp(-((90 * (1 - up)) / 1.5).square())[:, None] * width
        depth = 60 * (1 - (skin[..., 0] / 100).square() - (skin[..., 1] / 130).square()) + lips + crease
        front = torch.cat([skin, depth[..., None]], dim=-1)
        inner = front[-1:].repeat(INSIDE, 1, 1)
        inner[..., 2] -= 2.0 * torch.arange(1, INSIDE + 1, dtype=torch.float64)[:, None] * width
        both = torch.cat([front, inner])
        rows.append(both if side < 0 else both.flip(0))
    return torch.cat(rows).reshape(-1, 3)


def faces(keep_inside: bool = True) -> Tensor:
    ids = torch.arange(2 * HALF * COLUMNS).reshape(2 * HALF, COLUMNS)
    a, b, c, d = ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]
    quads = torch.stack([a, b, c, d], dim=-1)
    if not keep_inside:
        quads = torch.cat([quads[: SKIN - 1], quads[-SKIN + 1 :]])
    quads = quads.reshape(-1, 4)
    return torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def rims() -> Tensor:
    """The vertices in the middle of both rims, (K,2)."""
    columns = torch.arange(14, COLUMNS - 14)
    return torch.stack([(SKIN - 1) * COLUMNS + columns, (2 * HALF - SKIN) * COLUMNS + columns], dim=1)


def apart(vertices: Tensor) -> Tensor:
    lower, upper = rims().T
    return (vertices[upper] - vertices[lower]).norm(dim=1)


@pytest.fixture(scope="module")
def template() -> Mesh:
    return Mesh(mouth(0.3), faces(), annotations=Annotations(contacts=rims()))


def scan_of(vertices: Tensor) -> Mesh:
    return Mesh(vertices, faces(keep_inside=False))


def with_contacts(weight: float, template: Mesh, truth: Tensor) -> Registration:
    stages = tuple(replace(s, contact_weight=min(s.contact_weight, weight)) for s in DEFAULT_SCHEDULE.stages)
    skin = torch.tensor([5, 20, 35, COLUMNS * 10 + 4, COLUMNS * 44 + 36, COLUMNS * 53 + 20])
    picked = torch.cat([skin, rims()[::6].flatten()])
    return register(
        template, scan_of(truth), (picked, truth[picked]), schedule=replace(DEFAULT_SCHEDULE, stages=stages)
    )


def test_shut_lips_stay_shut_on_other_lips(template: Mesh) -> None:
    before, after = (
        apart(with_contacts(weight, template, mouth(0.8, bulge=3.0)).mesh.vertices) for weight in (0.0, 9.0)
    )
    assert float((after - 0.3).abs().max()) < 0.1
    assert float(after.mean()) < float(before.mean())


def test_open_lips_are_left_open(template: Mesh) -> None:
    truth = mouth(7.0)
    result = with_contacts(9.0, template, truth)
    assert float(apart(result.mesh.vertices).max()) > 4.5


def test_pairs_are_let_go_where_the_scan_is_open(template: Mesh) -> None:
    pull = contact_pull(template.vertices, template)
    assert torch.equal(pull.pairs[pull.pairs[:, 0].argsort()], rims())
    torch.testing.assert_close(pull.offsets, template.vertices[pull.pairs[:, 1]] - template.vertices[pull.pairs[:, 0]])
    for gap, least, most in ((0.3, 0.9, 1.0), (8.0, 0.0, 0.1)):
        open_mouth = scan_of(mouth(gap))
        index, caster = (make(open_mouth.vertices, open_mouth.faces) for make in (SurfaceIndex, RayCaster))
        weights = pull.weights(mouth(gap), index, caster)
        assert least <= float(weights.min())
        assert float(weights.max()) <= most


def test_without_names_what_faces_itself_is_found(template: Mesh) -> None:
    pairs = contact_pull(template.vertices, replace(template, annotations=None)).pairs
    rows = pairs // COLUMNS
    assert len(pairs) > 20
    assert bool((rows >= SKIN - 2).all())
    assert bool((rows <= 2 * HALF - SKIN + 1).all())
    assert bool(((rows < HALF).sum(1) == 1).all())  # one of the lower lip, one of the upper

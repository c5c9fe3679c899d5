"""Photographs of one head from several sides move it to where they show its skin; others move nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import trimesh
from torch import Tensor

from planted.photographed_heads import bent, to_surface
from torchface import BlendshapeRig, Mesh
from torchface.geometry.cameras.pinhole import Camera, look_at
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_landmark_points, load_mesh
from torchface.modeling import FitSettings, HeadModel, fit_images
from torchface.modeling.photographs.face_piece import FacePiece
from torchface.modeling.photographs.image_fit import ImageFit
from torchface.modeling.photographs.multiple_views import Forms, HeldMarks, ShownHead, agreed_skin, behind_lids
from torchface.modeling.photographs.skin_matches import match_skin, skin_vertices
from torchface.rendering.clay_shading import Lighting, render
from torchface.synthetic import character, draw_identities, performer
from torchface.workflows.fit.photograph_rig import _skin_line

SIZE, YAWS = 288, (-24.0, 0.0, 24.0)
LIGHT = Lighting(occlusion_rays=0)


@dataclass(frozen=True, eq=False)
class Taken:
    """A head, what cameras took of it, and where its landmarks are in the pictures."""

    head: Mesh
    cameras: list[Camera]
    images: list[Tensor]

    @property
    def landmarks(self) -> Tensor:
        places = self.head.vertices[self.head.landmarks].double()
        return torch.stack([camera.project(places) for camera in self.cameras])


def taken(head: Mesh, yaws: Sequence[float] = YAWS) -> Taken:
    middle = head.vertices[head.landmarks[27:]].double().mean(0)
    cameras = [look_at(middle, yaw, 3.0, 280.0, SIZE, SIZE, 14.0) for yaw in yaws]
    return Taken(head, cameras, [render(head, camera, lighting=LIGHT)[:3] for camera in cameras])


def person(seed: int) -> Mesh:
    return character(performer(draw_identities(1, torch.Generator().manual_seed(seed))[0]), size=512).rig.neutral


@pytest.fixture(scope="module")
def shot() -> Taken:
    return taken(person(21))


@pytest.fixture(scope="module")
def pair(shot: Taken) -> Taken:
    return Taken(shot.head, shot.cameras[:2], shot.images[:2])


def inner_face(mesh: Mesh) -> Tensor:
    """Skin between the brows, the chin and the eyes' corners, (V,) bool."""
    inner = mesh.vertices[mesh.landmarks[17:]]
    low, high = inner.amin(0) - 5.0, inner.amax(0) + 5.0
    return mesh.regions["face"] & ((mesh.vertices > low) & (mesh.vertices < high))[:, :2].all(1)


def wrong_head(shot: Taken, moved: Tensor) -> ShownHead:
    posed = [shot.head.with_vertices(shot.head.vertices + moved.float())] * len(shot.cameras)
    return ShownHead(posed, shot.cameras, torch.zeros(0, *moved.shape))


def pieces(shot: Taken) -> list[FacePiece]:
    return [FacePiece.around(image, marks) for image, marks in zip(shot.images, shot.landmarks, strict=True)]


def marks(shot: Taken) -> HeldMarks:
    return HeldMarks(shot.head.landmarks[17:], shot.landmarks[:, 17:], 2.0)


def test_matches_are_where_the_true_head_has_them(shot: Taken) -> None:
    """A place of a bent head's skin shows another one of the true head's: where its ray meets that, others show it."""
    moved = bent(shot.head)
    head, cut = wrong_head(shot, moved), pieces(shot)
    cameras = [piece.camera(camera) for piece, camera in zip(cut, shot.cameras, strict=True)]
    matches = match_skin(head.posed, cameras, cut, None)
    assert matches is not None
    true = trimesh.Trimesh(shot.head.vertices.numpy(), shot.head.faces.numpy(), process=False)
    own = {int(site): (int(view), at) for site, view, at, mine in zip(
        matches.site, matches.view, matches.pixels, matches.own, strict=True) if mine}  # fmt: skip
    rows = (~matches.own).nonzero()[::20, 0]
    off, before = [], []
    for row in rows.tolist():
        view, pixel = own[int(matches.site[row])]
        camera, other = cameras[view], cameras[int(matches.view[row])]
        ray = torch.linalg.solve(camera.intrinsics, torch.cat([pixel, pixel.new_ones(1)])) @ camera.rotation.double()
        hits, _, _ = true.ray.intersects_location(camera.centre[None].numpy(), ray[None].numpy())
        place = torch.from_numpy(hits)[(torch.from_numpy(hits) - camera.centre).norm(dim=1).argmin()]
        site = matches.site[row]
        corners = shot.head.faces[matches.triangles[site]]
        assumed = (head.posed[0].vertices[corners].double() * matches.barycentric[site][:, None]).sum(0)
        off.append(float((other.project(place) - matches.pixels[row]).norm()))
        before.append(float((other.project(place) - other.project(assumed)).norm()))
    far = torch.tensor(before) > 0.7
    assert int(far.sum()) > 20
    assert torch.tensor(off)[far].median() < 0.3 * torch.tensor(before)[far].median()
    assert torch.tensor(off).median() < 0.3


def test_a_bent_head_straightens(shot: Taken) -> None:
    moved = bent(shot.head)
    found = agreed_skin(wrong_head(shot, moved), pieces(shot), marks(shot))
    assert found is not None
    face = inner_face(shot.head)
    heads = (shot.head.vertices.double() + by for by in (moved, moved + found.moved))
    before, after = (to_surface(head[face], shot.head) for head in heads)
    assert after < 0.55 * before
    assert found.after < 0.5 * found.before


@pytest.mark.parametrize(
    ("deviation", "low", "high"),
    [(0.0, 0.9999, 1.0001), (0.3, 0.8, 0.93), pytest.param(0.02, 0.96, 1.04, marks=pytest.mark.bench)],
)
def test_a_focal_length_that_is_known_stays(pair: Taken, deviation: float, low: float, high: float) -> None:
    longer = torch.tensor([[1.15, 1.0, 1.0], [1.0, 1.15, 1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    middle = pair.head.vertices[pair.head.landmarks[27:]].double().mean(0)
    cameras = []
    for camera in pair.cameras:  # further away, and the face as large as before
        further = camera.translation + 0.15 * (camera.translation + camera.rotation @ middle)
        cameras.append(replace(camera, intrinsics=longer * camera.intrinsics, translation=further))
    head = replace(wrong_head(pair, bent(pair.head)), cameras=cameras, focal_deviation=deviation)
    found = agreed_skin(head, pieces(pair), marks(pair))
    assert found is not None
    length = float(found.cameras[0].intrinsics[0, 0] / cameras[0].intrinsics[0, 0])
    assert low < length < high


def test_photographs_of_other_skin_move_nothing(shot: Taken) -> None:
    other = taken(person(8))
    mixed = replace(shot, images=[shot.images[0], other.images[1], shot.images[2].flip(1)])
    assert agreed_skin(wrong_head(shot, bent(shot.head)), pieces(mixed), marks(shot)) is None
    two = Taken(shot.head, [shot.cameras[0], other.cameras[1]], [shot.images[0], other.images[1]])
    seen = torch.stack([shot.landmarks[0], other.landmarks[1]])
    between = shot.head.with_vertices((shot.head.vertices + other.head.vertices) / 2)
    cut = [FacePiece.around(image, at) for image, at in zip(two.images, seen, strict=True)]
    held = HeldMarks(shot.head.landmarks[17:], seen[:, 17:], 2.0)
    head = ShownHead([between] * 2, two.cameras, torch.zeros(0, *between.vertices.shape))
    assert agreed_skin(head, cut, held) is None


def test_photographs_from_one_angle_or_of_other_expressions_are_not_compared(shot: Taken) -> None:
    near = taken(shot.head, (-2.0, 0.0, 3.0))
    assert agreed_skin(wrong_head(near, bent(shot.head)), pieces(near), marks(near)) is None
    head = wrong_head(shot, bent(shot.head))
    open_mouth = [
        mesh.with_vertices(mesh.vertices + 4.0 * k * bent(shot.head).float()) for k, mesh in enumerate(head.posed)
    ]
    assert agreed_skin(replace(head, posed=open_mouth), pieces(shot), marks(shot)) is None


def test_a_head_that_agrees_already_stays(pair: Taken) -> None:
    """And its report does not say that photographs show other skin."""
    assert agreed_skin(wrong_head(pair, torch.zeros_like(bent(pair.head))), pieces(pair), marks(pair)) is None
    said = _skin_line(SimpleNamespace(agreement=None))  # type: ignore[arg-type]
    assert "agrees with it already" in said


def test_smooth_forms_vary_as_the_covariance_says(shot: Taken) -> None:
    """Out of the skin by 3.2 mm, along it by 0.3 of that, in the mean over the face."""
    forms = Forms.of(shot.head, torch.zeros(0, len(shot.head.vertices), 3))
    x = torch.randn(2000, forms.count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    row = int(shot.head.landmarks[33])
    drawn = torch.stack([forms.field(one)[row] for one in x[:400]])
    out, along = (drawn @ forms.ways[row, k] / forms.ways[row, k].norm() for k in (0, 1))
    assert abs(float(out.std()) - 10.0**0.5) < 0.4
    assert abs(float(along.std()) / float(out.std()) - 0.3) < 0.05


def test_eyeballs_do_not_bend_and_stay_behind_their_lids(shot: Taken) -> None:
    forms = Forms.of(shot.head, torch.zeros(0, len(shot.head.vertices), 3))
    x = 0.5 * torch.randn(forms.count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    at, skin = shot.head.vertices.double(), skin_vertices(shot.head)
    moved = behind_lids(shot.head, forms.field(x))
    for side in ("left", "right"):
        ball = shot.head.regions[f"eyeball_{side}"]
        assert float((moved[ball] - moved[ball][0]).norm(dim=1).max()) < 1e-9
        assert float((forms.field(x)[ball] - moved[ball]).norm(dim=1).max()) > 0.5
        middle, centre = at[ball].mean(0), (at + moved)[ball].mean(0)
        lids = skin & ((at - middle).norm(dim=1) < 1.2 * (at - middle).norm(dim=1)[ball].max()) & (at[:, 2] > middle[2])
        before, after = (at - middle)[lids].norm(dim=1), (at + moved - centre)[lids].norm(dim=1)
        assert float((after - before).min()) > -0.5


def test_what_photographs_agree_on_stands_as_the_rig(shot: Taken, model: HeadModel) -> None:
    """A rig that stands 50 mm further and turned by 20 degrees."""
    seen = taken(shot.head.with_vertices(shot.head.vertices + bent(shot.head).float()), YAWS[1:])
    rig = performer(texture=False).select(["jawOpen"])
    turn = rotation_matrix(torch.tensor([[0.0, 0.35, 0.0]]))[0]
    turned = rig.neutral.with_vertices(rig.vertices @ turn.T + torch.tensor([50.0, 0.0, 0.0]))
    rig = BlendshapeRig(turned, rig.deltas @ turn.T, rig.names)
    fit = fit_images(
        model, rig, seen.landmarks, (SIZE, SIZE), seen.images, settings=FitSettings(transfers=0, texture_size=0)
    )
    assert fit.agreement is not None
    nose = fit.mesh.vertices[fit.mesh.landmarks[30]]
    for camera, agreed in zip(fit.cameras, fit.agreement.cameras, strict=True):
        assert float((camera.project(nose[None].double()) - agreed.project(nose[None].double())).norm()) < 1e-3


@pytest.mark.real
def test_the_real_scan_photographed_from_three_sides(data: Path, rig: BlendshapeRig, model: HeadModel) -> None:
    """The face inside its outline, to the scan: nearer by a quarter than what the landmarks alone give."""
    scan = load_mesh(data / "scans" / "james" / "james.obj")
    given = load_landmark_points(data / "scans" / "james" / "james.ljson").ibug().double()
    right = torch.nn.functional.normalize(given[45] - given[36], dim=0)
    up = given[27] - given[8]
    up = torch.nn.functional.normalize(up - (up @ right) * right, dim=0)
    frame = torch.stack([right, up, torch.linalg.cross(right, up)])
    middle = given[27:].mean(0)
    upright = scan.with_vertices(((scan.vertices.double() - middle) @ frame.T).float())
    places = (given - middle) @ frame.T
    cameras = [look_at(torch.zeros(3).double(), yaw, 3.0, 280.0, SIZE, SIZE, 14.0) for yaw in YAWS]
    images = [render(upright, camera, lighting=LIGHT)[:3] for camera in cameras]
    seen = torch.stack([camera.project(places) for camera in cameras])

    def apart(fit: ImageFit) -> float:
        at = fit.mesh.vertices[rig.neutral.landmarks].double()
        move = similarity_transform(at[17:][None], places[17:][None])
        shown = fit.mesh.vertices[inner_face(fit.mesh)].double()
        return to_surface(move.apply(shown[None])[0], upright)

    found = {
        way: fit_images(
            model, rig, seen, (SIZE, SIZE), images, settings=FitSettings(transfers=0, texture_size=0, match_skin=way)
        )
        for way in (False, True)
    }
    assert found[True].agreement is not None
    assert apart(found[True]) < 0.75 * apart(found[False])

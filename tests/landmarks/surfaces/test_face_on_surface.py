"""Faces are found on surfaces in any pose and unit, where they are; what is no face is refused with pictures."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from planted.characters import box_mesh
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.landmarks.images.checked_detector import shipped_detector
from torchface.landmarks.surfaces.face_on_surface import (
    FaceOnSurface,
    FaceSearch,
    NoFaceOnSurfaceError,
    ReferencePoints,
)
from torchface.rendering.textured_surface import Material, TexturedSurface
from torchface.synthetic import draw_identities, neutral_head
from torchface.workflows.named_finders import load_finder
from torchface.workflows.rig.character_face import mesh_surface

RINGS = ((0.0, 6), (55.0, 4), (-55.0, 4))


def clay(vertices: Tensor, faces: Tensor) -> TexturedSurface:
    skin = Material(torch.tensor([0.8, 0.65, 0.56, 1.0]))
    material = torch.zeros(len(faces), dtype=torch.int64)
    return TexturedSurface(vertices.double(), faces, torch.zeros(len(vertices), 2), material, (skin,))


@pytest.fixture(scope="module")
def search() -> FaceSearch:
    mean, finder = neutral_head(texture=False), load_finder()
    points = ReferencePoints(
        mean.vertices[mean.landmarks], finder.places, lambda painted: mesh_surface(neutral_head(texture=painted))
    )
    return FaceSearch(shipped_detector(), finder.finder, points, RINGS)


@pytest.mark.parametrize(
    ("turn", "painted", "limit"),
    [pytest.param((-1.4, 0.4, 0.2), False, 0.02, marks=pytest.mark.bench), ((0.3, 2.5, 1.0), True, 0.02)],
)
def test_points_lie_where_the_head_has_them(
    search: FaceSearch, turn: tuple[float, ...], painted: bool, limit: float
) -> None:
    """On its back in clay; turned anyhow, painted."""
    head = neutral_head(draw_identities(1, torch.Generator().manual_seed(7))[0], texture=painted)
    mean = neutral_head(texture=False).vertices.double()
    rotation = rotation_matrix(torch.tensor(turn, dtype=torch.float64))
    placed = 0.01 * head.vertices.double() @ rotation.T + 5.0  # in another unit, elsewhere
    found = search.find(mesh_surface(head.with_vertices(placed)))
    ids = torch.cdist(search.reference.points.double(), mean).argmin(1)
    error = (found.points[68:] - placed[ids]).norm(dim=-1) / (found.points[36] - found.points[45]).norm()
    assert float(error.nanmedian()) < limit
    assert float(torch.isfinite(error).double().mean()) > 0.9
    forward = found.pose.rotation[0] @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert float(forward @ (rotation @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))) > 0.99
    assert found.presence > 0.9


def test_a_ball_a_box_and_the_back_of_a_head_are_no_faces(search: FaceSearch) -> None:
    head = neutral_head(texture=False)
    behind = head.faces[(head.vertices[head.faces][..., 2] < -10).all(1)]
    box, triangles = box_mesh(torch.zeros(3), torch.tensor([200.0, 240.0, 180.0]))
    round_box, fine = box_mesh(torch.zeros(3), torch.tensor([2.0, 2.0, 2.0]), divisions=4)
    ball = 100 * torch.nn.functional.normalize(round_box, dim=-1)
    for vertices, faces in ((box, triangles), (ball, fine), (head.vertices, behind)):
        with pytest.raises(NoFaceOnSurfaceError, match=r"found no face|not from near") as refused:
            replace(search, rings=((0.0, 3),)).find(clay(vertices, faces))
        assert len(refused.value.views) > 0


@pytest.mark.parametrize(("clear", "chosen"), [(True, 2), (False, 1)])
def test_a_doubtful_face_is_taken_only_where_all_directions_show_no_better_one(
    clear: bool, chosen: int, search: FaceSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ICT-FaceKit's head with hair, z up: its crown was taken for a face, and its face was not looked at."""
    one = torch.ones(1, dtype=torch.float64)
    pose = Similarity(one, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    read = {0: (0.70, 0.27), 1: (0.72, 0.26), 2: (1.0, 0.07)}
    found = {
        key: FaceOnSurface(torch.zeros(68, 3), pose, *values, (), torch.zeros(0, 3)) for key, values in read.items()
    }
    seen = [(SimpleNamespace(number=number, score=0.8), None) for number in read]
    rounds = iter([seen[:2], [seen[2], seen[0]] if clear else seen[:1]])
    monkeypatch.setattr(FaceSearch, "_candidates", lambda *_: next(rounds))
    monkeypatch.setattr(FaceSearch, "_from_near", lambda self, surface, group, *_: found[group.number])
    head = neutral_head(texture=False)
    assert search.find(clay(head.vertices, head.faces)) is found[chosen]


def test_a_doubtful_face_of_many_colours_is_looked_for_in_clay_too(
    search: FaceSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thin head in three colours on its back: its temple was taken for a face."""
    one = torch.ones(1, dtype=torch.float64)
    pose = Similarity(one, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    read = {False: (0.99, 0.212), True: (1.0, 0.154)}
    found = {
        key: FaceOnSurface(torch.zeros(68, 3), pose, *values, (), torch.zeros(0, 3)) for key, values in read.items()
    }
    monkeypatch.setattr(
        FaceSearch,
        "_candidates",
        lambda self, surface, framed, sure, plain, *_: [(SimpleNamespace(plain=plain, score=0.8), None)],
    )
    monkeypatch.setattr(FaceSearch, "_from_near", lambda self, surface, group, *_: found[group.plain])
    head = neutral_head(texture=False)
    plain = clay(head.vertices, head.faces)
    assert search.find(plain) is found[False]
    assert search.find(replace(plain, materials=2 * plain.materials)) is found[True]


@pytest.mark.parametrize(("likeness", "taken"), [(0.81, False), (0.0, True)])
def test_a_doubtful_face_is_not_taken_beside_a_surer_one_whose_form_is_no_heads(
    likeness: float, taken: bool, search: FaceSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A head with a long muzzle: its face was refused, and the side behind an ear was taken for one."""
    one = torch.ones(1, dtype=torch.float64)
    pose = Similarity(one, torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64))
    behind = FaceOnSurface(torch.zeros(68, 3), pose, 0.98, 0.195, (), torch.zeros(0, 3))

    def from_near(self: FaceSearch, surface: TexturedSurface, group: SimpleNamespace, *_: object) -> FaceOnSurface:
        if group.score > 0.8:
            raise NoFaceOnSurfaceError("its points lie elsewhere", (), likeness)
        return behind

    groups = [(SimpleNamespace(score=score), None) for score in (0.81, 0.71)]
    monkeypatch.setattr(FaceSearch, "_candidates", lambda *_: groups)
    monkeypatch.setattr(FaceSearch, "_from_near", from_near)
    head = neutral_head(texture=False)
    if taken:
        assert search.find(clay(head.vertices, head.faces)) is behind
    else:
        with pytest.raises(NoFaceOnSurfaceError, match="elsewhere"):
            search.find(clay(head.vertices, head.faces))


def test_a_head_with_holes_for_eyes_is_found_without_doubt(search: FaceSearch) -> None:
    """Points of the eyes were seen on the back of the head, through its eyes, and made the face doubtful: 0.28."""
    head = neutral_head(draw_identities(1, torch.Generator().manual_seed(3))[0], texture=False)
    regions = head.annotations.regions
    hollow = torch.stack([regions[name] for name in ("eyeball_left", "eyeball_right", "eye_sockets")]).any(0)
    faces = head.faces[~hollow[head.faces].any(1)]
    found = replace(search, rings=((0.0, 6),)).find(clay(head.vertices, faces))
    assert found.doubt < 0.12
    assert not bool(torch.isfinite(found.points[36:48, 2]).any()) or float(found.points[36:48, 2].nanmean()) > 0

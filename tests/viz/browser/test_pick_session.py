from dataclasses import replace

import pytest
import torch

from torchface import Annotations, Attachment, BlendshapeRig, Mesh, load_mesh, load_rig
from torchface.errors import AlignmentError, NameMismatchError, TopologyError, ValueRangeError
from torchface.io import load_correspondences, load_landmarks
from torchface.viz.browser.landmark_sets import IBUG_68, THESIS_12, custom_set
from torchface.viz.browser.pick_session import PickSession, SurfacePoint
from torchface.viz.browser.picker import Picker, save_picks

EARS = custom_set(["chin", "left ear", "right ear"])


def rays_at(mesh: Mesh, ids: list[int], seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from outside, each through a point very near to a vertex, from a random direction above the surface."""
    generator = torch.Generator().manual_seed(seed)
    places = mesh.vertices[ids].double()
    outward = torch.nn.functional.normalize(places, dim=1)
    origin = places + 300 * (outward + 0.2 * torch.randn(places.shape, generator=generator, dtype=torch.float64))
    return origin, places - origin


def surface(session: PickSession, vertex: int) -> SurfacePoint:
    origin, direction = rays_at(session.mesh, [vertex], seed=vertex)
    return session.on_mesh(origin[0], direction[0])


def test_landmark_sets_mirror_like_the_face_does() -> None:
    for known in (IBUG_68, THESIS_12):
        mirror = torch.tensor(known.mirror)
        assert torch.equal(mirror[mirror], torch.arange(len(known.names)))
        for name, twin in zip(known.names, known.mirror, strict=True):
            if "left" in name or "right" in name:
                side = "left" if "left" in name else "right"
                assert {"left": "right", "right": "left"}[side] in known.names[twin]
    assert len(IBUG_68.names) == 68
    # The chin, the bridge of the nose, the middle of the nose's base and of each lip are their own twins.
    own = [row for row, twin in enumerate(IBUG_68.mirror) if row == twin]
    assert own == [8, 27, 28, 29, 30, 33, 51, 57, 62, 66]


@pytest.mark.real
def test_the_68_mirror_like_a_real_heads_landmarks(ict_folder) -> None:
    rig = load_rig(ict_folder, shapes=["jawOpen"])
    points = rig.vertices[rig.neutral.landmarks]
    flipped = points[torch.tensor(IBUG_68.mirror)] * torch.tensor([-1.0, 1.0, 1.0])
    # ICT's own picks are not symmetric to the millimetre, but no wrong twin lies as near.
    assert (points - flipped).norm(dim=1).max() < 4.0
    assert torch.cdist(points, points * torch.tensor([-1.0, 1.0, 1.0])).argmin(1).tolist() == list(IBUG_68.mirror)


def test_a_ray_finds_the_vertex_it_was_aimed_at(two_balls: Mesh) -> None:
    session = PickSession(two_balls)
    ids = [0, 17, 400, 1234, 2000]
    assert [surface(session, vertex).vertex for vertex in ids] == ids
    away = session.on_mesh(torch.tensor([0.0, 0, 500]), torch.tensor([0.0, 0, 1]))
    assert away is None


def test_a_ray_stops_at_what_stands_in_front(two_balls: Mesh) -> None:
    session = PickSession(two_balls)
    found = session.on_mesh(torch.tensor([0.0, 0.0, 500.0]), torch.tensor([0.0, 0.0, -1.0]))
    assert found.vertex >= 2562  # the small ball hides the large one
    assert abs(found.position[2] - 125.0) < 0.5


def test_the_point_is_where_barycentric_says(two_balls: Mesh) -> None:
    session = PickSession(two_balls)
    origin = torch.tensor([30.0, 40.0, 400.0], dtype=torch.float64)
    found = session.on_mesh(origin, torch.tensor([0.0, 0.0, -1.0]))
    corners = two_balls.vertices[two_balls.faces[found.triangle]].double()
    torch.testing.assert_close(
        torch.tensor(found.barycentric, dtype=torch.float64) @ corners, corners.new_tensor(found.position)
    )
    assert abs(found.position[0] - 30) + abs(found.position[1] - 40) < 1e-3


def test_landmarks_fill_up_in_order_and_undo_takes_one_step_back(two_balls: Mesh) -> None:
    session = PickSession(two_balls, landmark_set=EARS)
    assert [session.pick_landmark(surface(session, v)) for v in (5, 50)] == [0, 1]
    assert session.picks.landmarks == (5, 50, None)
    assert session.pick_landmark(surface(session, 60), row=0) == 0
    assert session.picks.landmarks == (60, 50, None)
    assert session.undo()
    assert session.picks.landmarks == (5, 50, None)
    session.pick_landmark(surface(session, 70))
    with pytest.raises(ValueRangeError, match="all 3 are picked"):
        session.pick_landmark(surface(session, 70))
    assert [session.undo() for _ in range(4)] == [True, True, True, False]
    assert session.picks.landmarks == (None, None, None)


@pytest.mark.parametrize("annotate", [False, True])
def test_a_mirrored_landmark_sets_its_twin_to_the_mirrored_vertex(two_balls: Mesh, annotate: bool) -> None:
    flipped = two_balls.vertices * torch.tensor([-1.0, 1.0, 1.0])
    twins = torch.cdist(flipped.double(), two_balls.vertices.double()).argmin(1)
    mesh = replace(two_balls, annotations=Annotations(mirror=twins)) if annotate else two_balls
    session = PickSession(mesh, landmark_set=EARS)
    right = int(two_balls.vertices[:, 0].argmin())
    session.pick_landmark(surface(session, right), mirrored=True, row=2)
    left = session.picks.landmarks[1]
    torch.testing.assert_close(two_balls.vertices[left], two_balls.vertices[right] * torch.tensor([-1.0, 1, 1]))
    assert session.picks.landmarks[0] is None
    assert [session.undo(), session.undo()] == [True, False]  # both sides are one step


def test_a_head_that_stands_aside_is_mirrored_about_its_own_middle(two_balls: Mesh) -> None:
    aside = two_balls.vertices + torch.tensor([400.0, 1700.0, 0.0])
    session = PickSession(two_balls.with_vertices(aside), landmark_set=EARS)
    right = int(aside[:, 0].argmin())
    ahead = torch.tensor([1.0, 0.001, 0.001])
    session.pick_landmark(session.on_mesh(aside[right] - 100 * ahead, ahead), mirrored=True, row=2)
    left = aside[session.picks.landmarks[1]] - aside[right]
    torch.testing.assert_close(left, torch.stack([2 * (400 - aside[right, 0]), left[1] * 0, left[2] * 0]))
    with pytest.raises(ValueRangeError, match="pairs need a scan"):
        Picker(two_balls, mode="correspondences", port=0)
    turned = PickSession(two_balls.with_vertices(two_balls.vertices[:, [2, 1, 0]]), landmark_set=EARS)
    with pytest.raises(ValueRangeError, match="expected a head that looks along z"):
        turned.pick_marker(turned.on_mesh(torch.tensor([300.0, 0.3, 0.3]), -ahead), mirrored=True)


def test_names_of_landmarks_are_told_apart_before_the_first_is_picked() -> None:
    for names in (["chin", "chin"], ["chin", ""], ["next"]):
        with pytest.raises(NameMismatchError, match="expected each once"):
            custom_set(names)


@pytest.mark.parametrize("annotate", [False, True])
def test_a_mirrored_marker_lies_at_the_mirror_image(two_balls: Mesh, annotate: bool) -> None:
    flipped = two_balls.vertices * torch.tensor([-1.0, 1.0, 1.0])
    twins = torch.cdist(flipped.double(), two_balls.vertices.double()).argmin(1)
    session = PickSession(replace(two_balls, annotations=Annotations(mirror=twins)) if annotate else two_balls)
    point = session.on_mesh(torch.tensor([33.0, -21.0, 300.0]), torch.tensor([0.0, 0.0, -1.0]))
    assert session.pick_marker(point, mirrored=True) == ("marker000", "marker001")
    places = session.attachment().on(two_balls.faces, two_balls.vertices)
    assert (places[0] - places[1] * torch.tensor([-1.0, 1.0, 1.0])).norm() < 0.05
    middle = session.on_mesh(torch.tensor([0.3, -40.0, 300.0]), torch.tensor([0.0, 0.0, -1.0]))
    assert session.pick_marker(middle, "CHIN", mirrored=True) == ("CHIN",)  # its image would sit on it
    with pytest.raises(ValueRangeError, match="'CHIN' twice"):
        session.pick_marker(middle, "CHIN")


def test_pairs_want_the_template_first(two_balls: Mesh) -> None:
    scan = two_balls.with_vertices(two_balls.vertices + torch.tensor([5.0, 0.0, 0.0]))
    session = PickSession(two_balls, scan)
    origin, direction = rays_at(scan, [100])
    there = session.on_scan(origin[0], direction[0])
    with pytest.raises(ValueRangeError, match="expected one on the template"):
        session.pick_scan(there)
    session.pick_template(surface(session, 99))
    session.pick_template(surface(session, 100))  # a second thought
    assert session.pick_scan(there) == "pair000"
    pairs = session.correspondences()
    assert pairs.vertices.tolist() == [100]
    torch.testing.assert_close(pairs.points[0].float(), scan.vertices[100], atol=1e-3, rtol=0)


def test_everything_that_is_saved_comes_back(ball_rig: BlendshapeRig, tmp_path) -> None:
    mesh = ball_rig.neutral
    session = PickSession(mesh, mesh, EARS)
    with pytest.raises(ValueRangeError, match="found none"):
        save_picks(session, tmp_path)
    for vertex in (5, 50):
        session.pick_landmark(surface(session, vertex))
    assert [path.name for path in save_picks(session, tmp_path / "a")] == ["landmarks.json"]
    partial = load_landmarks(tmp_path / "a" / "landmarks.json")
    assert (partial.vertices.tolist(), partial.labels) == ([5, 50], ("chin", "left ear"))
    partial.check(mesh)
    session.pick_landmark(surface(session, 60))
    point = session.on_mesh(torch.tensor([33.0, -21.0, 300.0]), torch.tensor([0.0, 0.0, -1.0]))
    session.pick_marker(point, "CHEEK")
    session.pick_template(surface(session, 7))
    session.pick_scan(surface(session, 8))
    written = save_picks(session, tmp_path / "b", ball_rig)
    assert [path.name for path in written] == [
        "landmarks.json",
        "annotated.glb",
        "attachment.json",
        "correspondences.json",
    ]
    rig = load_rig(tmp_path / "b" / "annotated.glb")
    assert rig.names == ball_rig.names  # the shapes are still there
    assert rig.neutral.landmarks.tolist() == [5, 50, 60]
    attachment = Attachment.load(tmp_path / "b" / "attachment.json")
    attachment.check(mesh)
    place = attachment.on(mesh.faces, mesh.vertices)[0]
    torch.testing.assert_close(place, torch.tensor(point.position), atol=1e-4, rtol=0)
    pairs = load_correspondences(tmp_path / "b" / "correspondences.json")
    assert pairs.vertices.tolist() == [7]
    torch.testing.assert_close(pairs.points[0].float(), mesh.vertices[8], atol=1e-3, rtol=0)
    again = PickSession(mesh, mesh, EARS)
    again.resume(tmp_path / "b")
    assert again.picks == replace(session.picks, markers=again.picks.markers)
    assert [label for label, _ in again.picks.markers] == ["CHEEK"]
    torch.testing.assert_close(again.attachment().on(mesh.faces, mesh.vertices)[0], place, atol=1e-4, rtol=0)
    assert [again.undo() for _ in range(3)] == [True, True, False]  # landmarks are moved, not taken back
    with pytest.raises(NameMismatchError, match="found 'chin', expected 'ear'"):
        PickSession(mesh, landmark_set=custom_set(["ear"])).resume(tmp_path / "b")
    with pytest.raises(TopologyError):
        PickSession(replace(mesh, faces=mesh.faces[1:], polygons=None), landmark_set=EARS).resume(tmp_path / "b")
    with pytest.raises(AlignmentError, match="mm off the scan, expected its own"):
        PickSession(mesh, mesh.with_vertices(1.1 * mesh.vertices), EARS).resume(tmp_path / "b")
    assert PickSession(rig.neutral, landmark_set=EARS).picks.landmarks == (5, 50, 60)  # and can be carried on
    save_picks(session, tmp_path / "c")
    assert load_mesh(tmp_path / "c" / "annotated.glb").landmarks.tolist() == [5, 50, 60]

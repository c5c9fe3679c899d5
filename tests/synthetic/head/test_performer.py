"""The embedded performer's shapes: what they do on the mean head and on random ones."""

import pytest
import torch

from torchface.geometry.meshes.operators import triangle_areas, triangle_normals
from torchface.shape_names import ARKIT, mirror
from torchface.synthetic import IDENTITY, draw_identities, performer
from torchface.synthetic.head.identity import anatomy
from torchface.synthetic.head.topology import EYE_RIM, MOUTH_BORDER, MOUTH_CONTACT, topology

HEADS = draw_identities(8, torch.Generator().manual_seed(12))


@pytest.fixture(scope="module")
def rig():
    return performer(texture=False)


@pytest.fixture(scope="module")
def crowd():
    return [(anatomy(c), performer(c, texture=False)) for c in HEADS]


def posed(rig, **weights: float) -> torch.Tensor:
    vector = torch.zeros(1, len(rig.names))
    for name, weight in weights.items():
        vector[0, rig.index([name])] = weight
    return rig(vector)[0]


def shown(rig) -> torch.Tensor:
    """Triangles of skin seen with mouth and eyes at rest: not inside lids, lips or nostrils."""
    regions = rig.neutral.annotations.regions
    hidden = regions["mouth_interior"] | regions["eye_sockets"] | regions["nostrils"]
    t = topology()
    inner_lid = t.rings["eye"][EYE_RIM + 1]
    hidden[inner_lid] = hidden[t.mirror[inner_lid]] = True
    return ~hidden[rig.neutral.faces].any(1)


def identity(**coefficients: float) -> torch.Tensor:
    vector = torch.zeros(len(IDENTITY))
    for name, value in coefficients.items():
        vector[[p.name for p in IDENTITY].index(name)] = value
    return vector


def test_shapes_are_arkits_but_the_tongue(rig):
    assert rig.names == tuple(name for name in ARKIT if name != "tongueOut")
    assert (rig.deltas.norm(dim=-1).amax(1) > 1.5).all()


def test_building_is_repeatable():
    assert torch.equal(performer(HEADS[0]).deltas, performer(HEADS[0]).deltas)


def test_left_and_right_shapes_are_mirror_images(crowd):
    for _, rig in crowd[:3]:
        twin = rig.neutral.annotations.mirror
        partner = mirror(rig.names)
        reflected = rig.deltas[partner][:, twin] * torch.tensor([-1.0, 1.0, 1.0])
        assert (reflected - rig.deltas).abs().max() < 1e-4


AREAS = {
    "eye": (["eyeBlinkLeft", "eyeSquintLeft", "eyeWideLeft", "eyeLookUpLeft", "eyeLookInLeft"], -36, 40),
    "brow": (["browInnerUp", "browDownLeft", "browOuterUpLeft"], -12, 70),
    "mouth": (["mouthSmileLeft", "mouthFrownLeft", "mouthPucker", "mouthFunnel", "mouthRollLower"], -125, -2),
    "jaw": (["jawOpen", "jawLeft", "jawForward"], -175, -20),
}


@pytest.mark.parametrize("area", list(AREAS))
def test_each_shape_moves_its_own_area_only(rig, area):
    names, low, high = AREAS[area]
    y = rig.vertices[:, 1]
    outside = (y < low) | (y > high)
    for name in names:
        delta = rig.deltas[rig.index([name])[0]].norm(dim=-1)
        assert delta[outside].max() < (0.5 if area == "mouth" else 0.3), name  # a smile lifts the skin beside the eyes
    border = rig.vertices[:, 1] < -160
    assert rig.deltas[:, border].abs().max() < 0.5


def test_one_sided_shapes_leave_the_other_side_alone(rig):
    right = rig.vertices[:, 0] < -12
    for name in rig.names:
        if name.endswith("Left") and name not in ("jawLeft", "mouthLeft"):
            assert rig.deltas[rig.index([name])[0], right].norm(dim=-1).max() < 0.6, name


def test_lids_meet_in_front_of_the_eyeball_on_every_head(crowd):
    for person, rig in crowd:
        closed = posed(rig, eyeBlinkLeft=1, eyeBlinkRight=1)
        notes = rig.neutral.annotations
        lids = notes.regions["lids_left"] | notes.regions["lids_right"]
        pairs = notes.contacts[lids[notes.contacts].all(1)]
        assert (closed[pairs[:, 0]] - closed[pairs[:, 1]]).norm(dim=1).max() <= 0.2
        t = topology()
        # Seen from the eye's centre, lid skin and lid edge lie outside the ball: triangle by triangle, at many points.
        ring = t.rings["eye"]
        near = torch.zeros(t.count, dtype=torch.bool)
        near[ring[4 : EYE_RIM + 2]] = True
        faces = rig.neutral.faces[near[rig.neutral.faces].all(1)]
        corner = torch.eye(3)
        share = torch.cat([corner, (corner + corner.roll(1, 0)) / 2, torch.full((1, 3), 1 / 3)])
        points = torch.einsum("sc,fcx->fsx", share, closed[faces]).reshape(-1, 3)
        ball = closed[t.eyeball] - person.eye_centres[0].float()
        reach = (points - person.eye_centres[0].float()).norm(dim=1)
        # The ball behind each point: its own radius there, cornea included.
        assert (reach > ball.norm(dim=-1).amax() - 0.05).all()


def test_lips_keep_together_where_the_jaw_opens_and_the_mouth_closes(crowd):
    for _, rig in crowd:
        rings = topology().rings["mouth"][MOUTH_CONTACT]
        upper, lower = rings[:13], rings[14:].flip(0)
        opened, closed = posed(rig, jawOpen=1), posed(rig, jawOpen=1, mouthClose=1)
        assert (opened[upper] - opened[lower]).norm(dim=1)[0] > 25
        assert (closed[upper] - closed[lower]).norm(dim=1).max() <= 0.5


@pytest.mark.parametrize("name", ["mouthPucker", "cheekPuff", "mouthSmileLeft", "jawLeft"])
def test_lips_stay_closed_where_they_pucker_smile_or_go_aside_and_cheeks_puff(crowd, name):
    for _, rig in crowd:
        rings = topology().rings["mouth"][MOUTH_CONTACT]
        delta = rig.deltas[rig.index([name])[0]]
        assert (delta[rings[:13], 1] - delta[rings[14:].flip(0), 1]).max() < 0.3


def test_jaw_turns_about_the_heads_own_joint(crowd):
    # Points of the chin move at right angles to the line from the joint, as a turn makes them, save the joint's glide.
    for person, rig in crowd:
        chin = rig.neutral.landmarks[[7, 8, 9]]
        offset = rig.vertices[chin] - person.hinges.mean(0).float()
        moved = offset + rig.deltas[rig.index(["jawOpen"])[0], chin] - torch.tensor([0.0, -1.0, -1.5])
        assert torch.allclose(moved[:, 1:].norm(dim=1), offset[:, 1:].norm(dim=1), rtol=0.02)


def test_eyes_turn_rigidly(rig):
    ball = rig.neutral.annotations.regions["eyeball_left"]
    centre = anatomy().eye_centres[0].float()
    for name in ("eyeLookUpLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft"):
        turned = posed(rig, **{name: 1})[ball] - centre
        rest = rig.vertices[ball] - centre
        assert torch.allclose(turned.norm(dim=1), rest.norm(dim=1), atol=1e-3), name
        front = rest[:, 2].argmax()
        way = turned[front] - rest[front]
        expected = {"Up": way[1] > 4, "Down": way[1] < -4, "In": way[0] < -4, "Out": way[0] > 4}
        assert expected[name.removeprefix("eyeLook").removesuffix("Left")], name


def test_no_skin_turns_over_in_any_shape_at_full_weight(rig, crowd):
    # mouthClose alone takes back an opening that is not there; it counts together with jawOpen. The red of the lips
    # may turn further than skin, as it does where a mouth opens wide, but not over.
    rings = topology().rings["mouth"]
    red = torch.zeros(len(rig.vertices), dtype=torch.bool)
    red[rings[MOUTH_BORDER + 1 :]] = red[topology().mirror[rings[MOUTH_BORDER + 1 :]]] = True
    limit = torch.where(red[rig.neutral.faces].any(1), -0.7, -0.2)
    for one in [rig, *(r for _, r in crowd[:3])]:
        faces, keep = one.neutral.faces, shown(one)
        normals, areas = triangle_normals(one.vertices, faces), triangle_areas(one.vertices, faces)
        rest = areas > 0.1  # corners of lids and lips come to points
        for name in one.names:
            pose = posed(one, jawOpen=1, mouthClose=1) if name == "mouthClose" else posed(one, **{name: 1})
            cosine = (triangle_normals(pose, faces) * normals).sum(1)
            assert (cosine > limit)[keep & rest].all(), name
            assert (triangle_areas(pose, faces) > 0.015 * areas)[keep & rest].all(), name


def test_a_smaller_mouth_smiles_less_and_a_longer_jaw_opens_wider():
    smile, jaw = "mouthSmileLeft", "jawOpen"
    size = lambda c, name: float(performer(c, texture=False).select([name]).deltas.norm(dim=-1).max())  # noqa: E731
    assert size(identity(mouth_width=-2), smile) < 0.95 * size(identity(mouth_width=2), smile)
    assert size(identity(face_height=-2), jaw) < 0.95 * size(identity(face_height=2), jaw)
    assert size(identity(eye_opening=-2), "eyeBlinkLeft") < 0.85 * size(identity(eye_opening=2), "eyeBlinkLeft")


def test_shapes_depend_smoothly_on_the_identity():
    drawn = HEADS[1].double()
    step = 1e-2 * torch.randn(len(IDENTITY), generator=torch.Generator().manual_seed(6)).double()
    at = [performer(drawn + k * step, texture=False).deltas.double() for k in (-1, 0, 1)]
    first, second = (at[2] - at[0]).norm() / 2, (at[2] - 2 * at[1] + at[0]).norm()
    assert second < 0.05 * first


def test_expressions_differ_between_people_by_more_than_scale(crowd):
    # What later learners are to find: shapes of different heads are alike but not copies.
    mean = performer(texture=False).deltas
    for _, rig in crowd:
        scale = (rig.deltas * mean).sum() / (mean * mean).sum()
        left = (rig.deltas - scale * mean).norm() / mean.norm()
        assert 0.015 < left < 0.5

"""Parts inside a head: how far they stand out, where they belong in a new head, and shapes that keep them in."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.characters import caricature
from torchface import BlendshapeRig, Mesh
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.io import load_ict_facekit, load_identity_modes
from torchface.modeling import InnerParts, clear_parts, inner_parts, place_parts, shape_depths, transfer_with_report
from torchface.modeling.rigging.part_clearance import penetration
from torchface.modeling.rigging.part_placement import with_mouth_behind_skin, with_placed_parts
from torchface.modeling.rigging.penetration import TOLERANCE
from torchface.modeling.rigging.transfer_system import ShapeTransfer
from torchface.registration import Registration
from torchface.registration.scan_colors import own_colors
from torchface.rendering.raycast import RayCaster
from torchface.synthetic import IDENTITY, performer
from torchface.synthetic.head.embedded_character import character

MOVED = torch.tensor([1.5, -1.0, -2.5])


def sphere(radius: float, rings: int = 24, opening: float = 0.0) -> tuple[Tensor, Tensor]:
    """Vertices and triangles of a ball about z, open in front within ``opening`` radians of the axis."""
    polar = torch.linspace(max(opening, 0.02), torch.pi - 0.02, rings, dtype=torch.float64)
    turn = torch.arange(2 * rings, dtype=torch.float64) * (torch.pi / rings)
    a, b = torch.meshgrid(polar, turn, indexing="ij")
    vertices = radius * torch.stack([a.sin() * b.cos(), a.sin() * b.sin(), a.cos()], dim=-1).view(-1, 3)
    columns = 2 * rings
    row, column = torch.meshgrid(torch.arange(rings - 1) * columns, torch.arange(columns), indexing="ij")
    beside = (column + 1) % columns
    first = torch.stack([row + column, row + columns + column, row + columns + beside], dim=-1)
    second = torch.stack([row + column, row + columns + beside, row + beside], dim=-1)
    return vertices, torch.cat([first.view(-1, 3), second.view(-1, 3)])


def ball_in_a_head() -> BlendshapeRig:
    """A ball of 12 mm behind a skin of 20 mm with a hole in front; the shape moves it 9.5 mm sideways, through."""
    skin, skin_faces = sphere(20.0, 40, opening=0.5)
    ball, ball_faces = sphere(12.0)
    vertices = torch.cat([skin, ball])
    delta = torch.zeros_like(vertices)
    delta[len(skin) :, 0] = 9.5
    out = torch.zeros_like(vertices)
    out[len(skin) :, 2] = 9.5
    mesh = Mesh(vertices, torch.cat([skin_faces, ball_faces + len(skin)]))
    return BlendshapeRig(mesh, torch.stack([delta, out]), ["through", "out"])


def test_a_ball_stands_out_by_what_it_came_through_the_skin_and_not_by_what_a_hole_shows() -> None:
    rig = ball_in_a_head()
    parts = inner_parts(rig)
    assert len(parts.vertices) == 48 * 24
    assert parts.hard.all()
    rest, through, out = shape_depths(rig, parts)
    assert float(rest.max()) == 0
    assert float(through.max()) == pytest.approx(1.5, abs=0.1)
    found = through[through > 0]
    assert len(found) > 10
    # 1.5 mm beyond the rim of the hole is air, with no skin behind it.
    assert float(out.max()) == 0


def test_bone_that_comes_through_pushes_the_skin_out_and_shapes_without_fault_stay_as_they_are() -> None:
    rig = ball_in_a_head()
    parts = inner_parts(rig)
    moving = BlendshapeRig(rig.neutral, rig.deltas + 0.02, rig.names)
    cleared = clear_parts(moving, parts)
    assert float(shape_depths(moving, parts)[1].max()) > 1
    assert float(shape_depths(cleared, parts)[1].max()) <= TOLERANCE
    assert torch.equal(cleared.deltas[1], moving.deltas[1])
    ball = parts.vertices
    assert torch.equal(cleared.deltas[:, ball], moving.deltas[:, ball])


def test_lips_that_close_over_an_open_jaw_keep_its_teeth_in() -> None:
    rig = ball_in_a_head()
    parts, ball = inner_parts(rig), rig.deltas[0]
    skin = 9.5 * (ball.norm(dim=-1) == 0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    whole = BlendshapeRig(rig.neutral, torch.stack([ball + skin, -skin]), ["jawOpen", "mouthClose"])
    cleared = clear_parts(whole, parts)
    assert float(parts.depth(whole(torch.ones(1, 2))[0]).max()) > 1
    assert float(parts.depth(cleared(torch.ones(1, 2))[0]).max()) <= TOLERANCE
    assert torch.equal(cleared.deltas[0], whole.deltas[0])


def eyes(rig: BlendshapeRig, parts: InnerParts, mesh: Mesh) -> tuple[Tensor, Tensor]:
    """Centres (2,3) and radii (2,) of the eyeballs."""
    places = [mesh.vertices[parts.vertices[parts.group == k]].double() for k in (0, 1)]
    centres = torch.stack([place.mean(0) for place in places])
    radii = torch.stack([(place - place.mean(0)).norm(dim=-1).mean() for place in places])
    return centres, radii


def test_another_performers_eyeballs_are_found_from_the_lids() -> None:
    """What the registration of a scan that shows no eyeballs leaves of them does not matter."""
    template = performer(texture=False)
    parts = inner_parts(template)
    assert parts.group.bincount().tolist() == [314, 314]
    assert torch.equal(place_parts(template, template.neutral, parts).vertices, template.vertices)
    generator = torch.Generator().manual_seed(4)
    for _ in range(3):
        true = performer(torch.randn(len(IDENTITY), generator=generator), texture=False).neutral
        spoiled = true.vertices.clone()
        balls = parts.vertices
        spoiled[balls] = MOVED + template.vertices[balls] * torch.tensor([1.0, 0.8, 1.2])
        placed = place_parts(template, true.with_vertices(spoiled), parts)
        wanted, radius = eyes(template, parts, true)
        found, found_radius = eyes(template, parts, placed)
        assert float((found - wanted).norm(dim=-1).max()) < 1.5
        assert float((found_radius / radius - 1).abs().max()) < 0.06
        skin = parts.label == parts.body
        assert float((placed.vertices - true.vertices)[skin].norm(dim=-1).max()) < 0.5
        _, template_radius = eyes(template, parts, template.neutral)
        sphere_error = (placed.vertices[balls] - found.float()[parts.group]).norm(dim=-1)
        own_error = (template.vertices[balls] - eyes(template, parts, template.neutral)[0].float()[parts.group]).norm(
            dim=-1
        )
        assert float((sphere_error / found_radius[parts.group] - own_error / template_radius[parts.group]).std()) < 5e-3


def with_bulge(rig: BlendshapeRig, bulge: float) -> BlendshapeRig:
    """The rig with a left eyeball that stands out by so many millimetres round the pupil."""
    ball = rig.neutral.annotations.regions["eyeball_left"]
    vertices, deltas, count = rig.vertices.double(), rig.deltas.double(), len(rig.names)
    eye = vertices[ball]
    centre = (eye.amax(0) + eye.amin(0)) / 2
    ways = torch.nn.functional.normalize(eye - centre, dim=-1)
    vertices[ball] = eye + bulge * ((ways[:, 2:] - 0.85) / 0.15).clamp(0, 1) * ways
    turn = similarity_transform(eye.expand(count, -1, -1), eye + deltas[:, ball], scale=False)
    deltas[:, ball] = turn.apply(vertices[ball].expand(count, -1, -1)) - vertices[ball]
    return BlendshapeRig(rig.neutral.with_vertices(vertices.float()), deltas.float(), rig.names)


def test_what_a_blink_meets_with_other_shapes_bends_it_little() -> None:
    """It is in most mixtures: shared evenly, their demands moved its lids by 2.1 mm, in a point before the pupil."""
    rig = performer(texture=False)
    own = with_bulge(rig.select([n for n in rig.names if n.startswith("eye") and n.endswith("Left")]), 3.0)
    parts, blink = inner_parts(own), own.names.index("eyeBlinkLeft")
    alone = clear_parts(own, parts, torch.eye(len(own.names)))
    bent = (clear_parts(own, parts).deltas - alone.deltas).norm(dim=-1)
    assert float(bent[blink].max()) < 1.2
    # Spread over more of the lids it crumpled them, and real heads' eyeWide looked like eyeLookUp.
    assert int((bent > 0.3)[:, own.neutral.regions["face"]].sum(1).max()) < 50


def test_mixtures_as_mild_as_those_of_takes_keep_a_bulging_eyeball_behind_the_lids() -> None:
    """Cleared in mixtures of 0.3 to 0.9 alone, it came out in six of these."""
    rig = performer(texture=False)
    own = with_bulge(rig.select([n for n in rig.names if n.startswith("eye") and n.endswith("Left")]), 3.0)
    parts, generator = inner_parts(own), torch.Generator().manual_seed(3)
    mild = torch.zeros(60, len(own.names))
    for row in mild:
        drawn = torch.randperm(len(row), generator=generator)[:3]
        row[drawn] = 0.1 + 0.4 * torch.rand(3, generator=generator)
    cleared = clear_parts(own, parts)
    assert sum(float(parts.depth(cleared(row[None])[0]).max()) > TOLERANCE for row in mild) <= 2


@pytest.mark.parametrize("strange", [False, True])
def test_lids_stay_before_an_eye_with_a_bulge_whichever_way_it_looks(strange: bool) -> None:
    names = ["eyeBlinkLeft", "eyeLookUpLeft", "eyeLookDownLeft", "eyeWideLeft"]
    rig = performer(texture=False).select(names)
    own = with_bulge(caricature(rig, rig.vertices[rig.neutral.landmarks], eyes=0.5) if strange else rig, 5.0)
    parts = inner_parts(own)

    def deepest(one: BlendshapeRig) -> Tensor:
        blink = one.deltas[:1]
        looks = BlendshapeRig(one.neutral, torch.cat([one.deltas, blink + one.deltas[1:]]), [*names, *"udw"])
        return shape_depths(looks, parts).amax(1)[1:]

    assert float(deepest(own).max()) > 3
    assert float(deepest(clear_parts(own, parts)).max()) <= TOLERANCE


def test_a_registration_that_bent_eyeballs_gets_round_ones_behind_the_lids() -> None:
    template = performer(texture=False)
    parts, true = inner_parts(template), performer(torch.full((len(IDENTITY),), 0.7), texture=False).neutral
    spoiled = true.vertices.double()
    balls = parts.vertices
    spoiled[balls] += torch.stack([torch.zeros(len(balls)), torch.zeros(len(balls)), 5 * spoiled[balls, 1].sin()], 1)
    turn = rotation_matrix(torch.tensor([0.1, 0.4, -0.3], dtype=torch.float64))
    pose = Similarity(torch.tensor([1.1]).double(), turn[None], torch.tensor([[5.0, 900.0, -40.0]]).double())
    seen = torch.ones(len(spoiled), dtype=torch.bool)
    bent = Registration(true.with_vertices(pose.apply(spoiled)[0]), pose, seen.double(), seen, None)
    found = pose.inverse().apply(with_placed_parts(template.select([]), bent).mesh.vertices)[0]
    assert float(parts.depth(spoiled).max()) > 1
    assert float(parts.depth(found).max()) <= TOLERANCE
    centres = eyes(template, parts, true)[0]
    off = (found[balls] - eyes(template, parts, true.with_vertices(found))[0][parts.group]).norm(dim=-1)
    own = (true.vertices[balls].double() - centres[parts.group]).norm(dim=-1)
    assert float((off - own * off.mean() / own.mean()).abs().max()) < 0.1


@pytest.mark.parametrize("bared", [{"mouthUpperUpLeft": 0.5, "mouthUpperUpRight": 0.5}, {"mouthFunnel": 0.8}])
def test_teeth_do_not_rise_with_a_lip_that_bares_them(bared: dict[str, float]) -> None:
    """They followed it wholly, by 3.8 and 3.9 mm."""
    template = character(size=64).rig.select(list(bared))
    parts, rest = inner_parts(template), template.vertices
    head = template(torch.tensor([[bared[name] for name in template.names]]))[0]
    head[parts.vertices] = rest[parts.vertices]
    placed = place_parts(template, template.neutral.with_vertices(head), parts).vertices
    teeth = template.neutral.regions["teeth_upper"]
    assert float((placed - rest)[teeth, 1].mean().abs()) < 1.5


@pytest.mark.parametrize(("higher", "wider"), [(-4.0, 1.0), (4.0, 1.0), (3.0, 1.15)])
def test_teeth_show_under_a_longer_or_shorter_upper_lip_as_in_the_template(higher: float, wider: float) -> None:
    """Placed by all the skin before them they hung 5.4 mm under the lip of a real scan."""
    template = character(size=64).rig.select(["jawOpen", "mouthSmileLeft", "mouthFunnel"])
    parts, rest = inner_parts(template), template.vertices
    teeth, lip = template.neutral.regions["teeth_upper"], template.neutral.landmarks[62]
    shift = torch.exp(-(((rest - rest[lip]).norm(dim=-1) / 25.0) ** 2))
    head = rest * torch.tensor([wider, 1.0, 1.0]) + higher * shift[:, None] * torch.tensor([0.0, 1.0, 0.0])
    head[parts.vertices] = rest[parts.vertices]
    placed = place_parts(template, template.neutral.with_vertices(head), parts)
    shown = [float((of[lip] - of[teeth])[:, 1].max()) for of in (rest, placed.vertices)]
    assert shown[1] == pytest.approx(shown[0], abs=0.3)
    bones = shape_depths(transfer_with_report(template, placed).rig, parts)[:, parts.hard]
    assert float(bones.max()) <= TOLERANCE


@pytest.mark.parametrize(
    ("skin", "whites", "found"), [(1.0, 1.0, 1.0), (0.65, 0.4, 0.75), (0.7, 0.85, 0.85), (0.3, 1.0, 1.0)]
)
def test_eyes_that_a_scan_hardly_shows_are_as_bright_as_its_light(skin: float, whites: float, found: float) -> None:
    """Of a dim scan and of a dark complexion: whites 1.45 times as bright as skin glowed in a real scan's rig."""
    rig = performer().select([])
    colors, ball = own_colors(rig.neutral), rig.neutral.regions["eyeball_left"] | rig.neutral.regions["eyeball_right"]
    template = replace(rig.neutral, colors=colors, texture=None)
    pose = Similarity(torch.ones(1).double(), torch.eye(3)[None].double(), torch.zeros(1, 3).double())
    seen = ~ball | (rig.vertices[:, 2] > 73)
    scanned = replace(template, colors=torch.where(ball[:, None], whites, skin) * colors)
    registration = Registration(scanned, pose, seen.double(), seen, None)
    placed = with_placed_parts(BlendshapeRig(template, rig.deltas, rig.names), registration).mesh.colors
    torch.testing.assert_close(placed[ball], found * colors[ball], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(placed[~ball], scanned.colors[~ball])


def test_a_tongue_that_is_put_out_pushes_no_lip_before_it() -> None:
    """On a real scan's head it drew the lower lip out by 23 mm, and was reported as standing out of the skin."""
    rig = character(size=64).rig.select(["jawOpen", "tongueOut"])
    parts = inner_parts(rig)
    assert float(shape_depths(rig, parts)[2].max()) > 1
    assert torch.equal(clear_parts(rig, parts).deltas[1], rig.deltas[1])
    found = penetration(rig, parts)
    assert found is not None
    assert "tongueOut" not in found.poses


@pytest.mark.parametrize(("opened", "left"), [(0.4, 0.0), (3.0, 3.0)])
def test_lips_that_a_registration_left_ajar_meet_and_parted_ones_stay_parted(opened: float, left: float) -> None:
    """The slit of a real scan's rig was 0.25 mm wide, and teeth shone through."""
    rig = performer(texture=False)
    upper, lower = rig.neutral.landmarks[62], rig.neutral.landmarks[66]
    jaw = rig.deltas[rig.names.index("jawOpen")]
    found = rig.vertices + (opened - 0.12) / float((jaw[upper] - jaw[lower])[1]) * jaw
    pose = Similarity(torch.ones(1).double(), torch.eye(3)[None].double(), torch.zeros(1, 3).double())
    seen = torch.ones(len(found), dtype=torch.bool)
    registration = Registration(rig.neutral.with_vertices(found), pose, seen.double(), seen, None)
    placed = with_placed_parts(rig.select([]), registration).mesh.vertices
    assert float((placed[upper] - placed[lower])[1]) == pytest.approx(left, abs=1e-3)
    moved = (placed - found).norm(dim=1)[rig.neutral.regions["upper_lip"] | rig.neutral.regions["lower_lip"]]
    assert float(moved.max()) <= (0.0 if left else 0.3)


@pytest.mark.parametrize("pose", ["rest", "open"])
def test_a_mouth_that_came_through_the_chin_lies_behind_it_again(pose: str) -> None:
    rig = performer(texture=False)
    head = rig.neutral
    if pose == "open":
        head = head.with_vertices(head.vertices + rig.deltas[rig.names.index("jawOpen")])
    assert torch.equal(with_mouth_behind_skin(head).vertices, head.vertices)
    bag = head.annotations.regions["mouth_interior"]
    floor = bag & (head.vertices[:, 1] < head.vertices[bag, 1].min() + 6)
    spoiled = head.vertices.clone()
    spoiled[floor, 2] += 14.0
    mended = with_mouth_behind_skin(head.with_vertices(spoiled)).vertices
    skin = head.faces[~bag[head.faces].any(1)]

    def shown(vertices: Tensor) -> int:
        at = vertices[floor].double()
        return int(
            (RayCaster(vertices.double(), skin).cast(at, at.new_tensor([0.0, 0, 1]).expand_as(at)).triangle < 0).sum()
        )

    assert shown(spoiled) > 5
    assert shown(mended) == 0
    assert torch.equal(mended[~bag], spoiled[~bag])


@pytest.mark.bench
@pytest.mark.real
def test_shells_stay_behind_the_closed_lids_of_random_heads(ict_folder: Path) -> None:
    names = ["eyeBlink_L", "eyeBlink_R"]
    template = load_ict_facekit(ict_folder, names)
    parts = inner_parts(template)
    regions = template.neutral.annotations.regions
    hard = {name for name, mask in regions.items() if bool(mask[parts.vertices[parts.hard]].any())}
    assert hard == {"gums_and_tongue", "teeth", "eyeball_left", "eyeball_right", "eye_blend_left", "eye_blend_right"}
    assert parts.group.unique().tolist() == [0, 1, 2]
    modes = load_identity_modes(ict_folder)
    for seed in (0, 1):
        head = modes.random_head(seed)
        job = ShapeTransfer(template, head, 30.0)
        before = job.rig(template, head, job.transfer())
        after = transfer_with_report(template, head).rig
        assert float(shape_depths(before, parts).max()) > 2 * TOLERANCE
        assert float(shape_depths(after, parts).max()) <= TOLERANCE


@pytest.mark.bench
@pytest.mark.real
def test_parts_that_registration_left_before_the_lips_go_behind_them(ict_folder: Path) -> None:
    template = load_ict_facekit(ict_folder, ["jawOpen", "eyeBlink_L"])
    parts = inner_parts(template)
    head = load_identity_modes(ict_folder).random_head(2)
    spoiled = head.vertices.clone()
    spoiled[parts.vertices] += torch.tensor([0.0, 1.0, 9.0])
    target = replace(head, vertices=spoiled)
    assert float(parts.depth(spoiled).max()) > 1
    placed = place_parts(template, target, parts)
    assert float(parts.depth(placed.vertices).max()) <= TOLERANCE
    moved = (placed.vertices - head.vertices)[parts.vertices[parts.hard]]
    assert float(moved.norm(dim=-1).mean()) < 3.0


@pytest.mark.bench
@pytest.mark.real
def test_lids_that_are_a_millimetre_off_do_not_turn_eyes_inward(ict_folder: Path) -> None:
    """Eyeballs of people's heads, against their true places, where the skin is a registration's."""
    template = load_ict_facekit(ict_folder, ["eyeBlink_L"])
    parts = inner_parts(template)
    skin = parts.label == parts.body
    modes, off = load_identity_modes(ict_folder), []
    for seed in range(4):
        head = modes.random_head(seed)
        generator = torch.Generator().manual_seed(seed)
        at = head.vertices[skin][torch.randint(int(skin.sum()), (600,), generator=generator)]
        near = torch.exp(-(torch.cdist(head.vertices[skin], at) ** 2) / (2 * 6.0**2))
        bumps = near @ torch.randn(600, 3, generator=generator)
        spoiled = head.vertices.clone()
        spoiled[skin] += bumps / bumps.std()
        placed = place_parts(template, head.with_vertices(spoiled), parts)
        for group in (1, 2):
            ball = parts.vertices[(parts.group == group) & parts.hard]
            off.append((placed.vertices - head.vertices)[ball].mean(0))
    across, up, front = torch.stack(off).square().mean(0).sqrt().tolist()
    assert across < 1.2
    assert up < 1.6
    assert front < 2.2

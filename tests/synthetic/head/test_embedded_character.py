"""The character that is shown of the performer: its parts, how shapes move them, its images, its file."""

import pytest
import torch

from torchface import BlendshapeRig, load_rig, save_rig
from torchface.errors import TopologyError
from torchface.geometry.meshes.operators import components
from torchface.geometry.similarity import similarity_transform
from torchface.modeling import inner_parts
from torchface.rendering.raycast import RayCaster
from torchface.shape_names import ARKIT
from torchface.synthetic import IDENTITY, Look, character, draw_identities, performer
from torchface.synthetic.head.hair_locks import hair_locks
from torchface.synthetic.head.signed_distance import signed_distance
from torchface.synthetic.head.skin_maps import skin_maps
from torchface.synthetic.head.topology import topology

_PAIRS = (
    ("jawOpen", "mouthSmile"), ("jawOpen", "mouthFunnel"), ("jawOpen", "mouthPucker"), ("jawOpen", "mouthStretch"),
    ("jawOpen", "mouthUpperUp"), ("jawOpen", "mouthLowerDown"), ("jawOpen", "mouthFrown"), ("jawOpen", "mouthClose"),
    ("jawOpen", "jawForward"), ("jawOpen", "jawLeft"), ("jawOpen", "mouthRollLower"), ("jawOpen", "mouthDimple"),
    ("mouthSmile", "mouthUpperUp"), ("mouthSmile", "mouthLowerDown"), ("mouthSmile", "cheekSquint"),
    ("mouthSmile", "eyeSquint"), ("mouthSmile", "mouthDimple"), ("mouthSmile", "mouthPress"),
    ("mouthPucker", "mouthFunnel"), ("mouthPucker", "cheekPuff"), ("mouthRollLower", "mouthRollUpper"),
    ("mouthShrugLower", "mouthShrugUpper"), ("mouthFrown", "mouthShrugLower"), ("mouthLeft", "jawLeft"),
    ("mouthUpperUp", "noseSneer"), ("eyeBlink", "browDown"), ("eyeBlink", "cheekSquint"), ("eyeWide", "browInnerUp"),
    ("eyeBlink", "eyeLookDown"), ("eyeLookDown", "eyeSquint"),
)  # fmt: skip


@pytest.fixture(scope="module")
def shown():
    return character(size=128)


def weights(rig, *names: str) -> torch.Tensor:
    """1 for shapes of these names, on both sides where a shape has one."""
    found = [n for n in rig.names if n in names or n.removesuffix("Left").removesuffix("Right") in names]
    vector = torch.zeros(1, len(rig.names))
    vector[0, rig.index(found)] = 1
    return vector


def test_all_shapes_of_arkit_and_the_performers_skin_unchanged(shown) -> None:
    actor, count = performer(texture=False), topology().count
    assert set(shown.rig.names) == set(ARKIT)
    assert torch.equal(shown.rig.vertices[:count], actor.vertices)
    assert (shown.rig.deltas[: len(actor.names), :count] - actor.deltas).abs().max() < 0.02
    label = components(shown.rig.neutral.faces, len(shown.rig.vertices))
    assert int(label.bincount().argmax()) == int(label[0])  # the skin is the largest part, as tools expect


def test_parts_mirror_each_other(shown) -> None:
    mesh = shown.rig.neutral
    mirror, regions = mesh.annotations.mirror, mesh.annotations.regions
    firm = regions["teeth_upper"] | regions["teeth_lower"] | regions["tongue"] | regions["lash_hair"]
    assert torch.equal(mirror[mirror][firm], firm.nonzero()[:, 0])
    reflected = mesh.vertices[mirror] * torch.tensor([-1.0, 1.0, 1.0])
    assert (reflected - mesh.vertices)[firm].abs().max() < 1e-3


def test_lower_teeth_go_rigidly_with_the_jaw_and_upper_ones_stay(shown) -> None:
    rig, regions = shown.rig, shown.rig.neutral.annotations.regions
    opened = rig(weights(rig, "jawOpen"))[0]
    lower, upper = regions["teeth_lower"], regions["teeth_upper"]
    assert torch.equal(opened[upper], rig.vertices[upper])
    fitted = similarity_transform(rig.vertices[lower][None], opened[lower][None], scale=False)
    assert (fitted.apply(rig.vertices[lower][None])[0] - opened[lower]).abs().max() < 0.02
    front = rig.vertices[lower][:, 2] > 78
    assert (opened[lower][front, 1] < rig.vertices[lower][front, 1] - 20).all()


@pytest.mark.parametrize("person", [None, pytest.param(1, marks=pytest.mark.bench), 4])
def test_no_part_comes_through_the_skin_in_any_shape_or_common_pair(shown, person) -> None:
    rig = shown.rig
    if person is not None:
        drawn = draw_identities(10, torch.Generator().manual_seed(5))[person]
        rig = character(performer(drawn, texture=False), size=128).rig
    parts = inner_parts(rig)
    poses = [(name,) for name in rig.names if name not in ("tongueOut", "mouthClose")]
    for names in [(), *(poses if person is None else ()), *_PAIRS]:
        depth = parts.depth(rig(weights(rig, *names))[0].double())
        assert depth.max() < 0.15, names


def test_tongue_comes_out_between_the_teeth_and_over_the_lip(shown) -> None:
    rig, regions = shown.rig, shown.rig.neutral.annotations.regions
    pose = rig(weights(rig, "tongueOut"))[0]
    tongue = pose[regions["tongue"]]
    lip = pose[rig.neutral.landmarks[[57, 66]]]
    assert tongue[:, 2].max() > lip[:, 2].max() + 12
    upper, lower = (pose[regions[f"teeth_{jaw}"]] for jaw in ("upper", "lower"))
    for teeth, sign in ((upper, 1.0), (lower, -1.0)):
        front = teeth[(teeth[:, 0].abs() < 8) & (teeth[:, 2] > teeth[:, 2].max() - 6)]
        near = tongue[(tongue[:, 0].abs() < 8) & (tongue[:, 2] > front[:, 2].min()) & (tongue[:, 2] < 86)]
        edge = (sign * front[:, 1]).min()
        assert (sign * near[:, 1] < edge + 0.8).all()  # below the upper edge, above the lower one


def test_lashes_stay_on_their_lids_and_turn_down_as_they_close(shown) -> None:
    rig, lash = shown.rig, shown.rig.neutral.annotations.regions["lash_hair"]
    shut = rig(weights(rig, "eyeBlink"))[0]
    tips = lash.nonzero()[:, 0].view(-1, 6)
    way = lambda v: v[tips[:, 4]] - v[tips[:, 0]]  # noqa: E731
    assert ((way(shut).norm(dim=1) - way(rig.vertices).norm(dim=1)).abs() < 0.05).all()
    long = way(rig.vertices).norm(dim=1) > 4
    assert (way(shut)[long, 1] < way(rig.vertices)[long, 1]).double().mean() > 0.9


def test_looks_differ_in_tone_age_and_hair() -> None:
    size = 128
    fair, dark, old = (skin_maps(look, size) for look in (Look(), Look(melanin=0.8), Look(age=75.0)))
    cheek = (slice(None), slice(int(0.62 * size), int(0.66 * size)), slice(int(0.60 * size), int(0.64 * size)))
    assert dark.color[cheek].mean() < 0.6 * fair.color[cheek].mean()
    assert dark.color[cheek][0].mean() > dark.color[cheek][2].mean()  # brown, not grey
    assert torch.allclose(fair.surface.neutral.norm(dim=0), torch.ones(size, size), atol=1e-4)
    assert (old.surface.neutral[2] < 0.999).double().mean() > (fair.surface.neutral[2] < 0.999).double().mean()
    assert fair.surface.roughness.min() >= 0.05
    assert fair.surface.roughness.max() <= 1


@pytest.mark.parametrize(("haircut", "lowest"), [("short", 30.0), ("long", -185.0), ("tied", -70.0)])
def test_locks_lie_on_the_head_and_reach_as_far_as_the_haircut(haircut, lowest) -> None:
    points = hair_locks(haircut).part.vertices
    assert signed_distance(points).min() > -2.5  # roots alone are under the skin
    assert abs(points[:, 1].min() - lowest) < 20
    face = (points[:, 2] > 60) & (points[:, 1] < 30)
    assert not face.any()


def test_a_fringe_covers_the_forehead_and_no_eye() -> None:
    bare, whole = (hair_locks("long", fringe).part.vertices for fringe in (False, True))
    fringe = whole[len(bare) :]
    assert signed_distance(fringe).min() > -2.5
    assert 20 < float(fringe[:, 1].min()) < 46  # the middle of brows lies at 21, lids at 6, hair begins at 60
    low = fringe[fringe[:, 1] < 50]
    assert float(low[:, 2].min()) > 40  # before the forehead
    assert float(low[:, 0].min()) < -30
    assert float(low[:, 0].max()) > 30
    assert len(character(look=Look(haircut="long", fringe=True), size=64).rig.vertices) == len(
        character(look=Look(haircut="long"), size=64).rig.vertices
    ) + len(fringe)


def test_haircuts_follow_other_heads(shown) -> None:
    large = torch.zeros(len(IDENTITY))
    large[[parameter.name for parameter in IDENTITY].index("head_width")] = 3.0
    wide = character(performer(large, texture=False), size=64).rig
    skin = slice(0, topology().count)
    spread = lambda rig, part: float(rig.vertices[part, 0].max() - rig.vertices[part, 0].min())  # noqa: E731
    locks = shown.rig.neutral.annotations.regions["hair_locks"]
    scalp = shown.rig.neutral.annotations.regions["cranium"]
    assert spread(wide, skin) > spread(shown.rig, skin) + 2
    assert abs(spread(wide, locks) - spread(wide, scalp) - spread(shown.rig, locks) + spread(shown.rig, scalp)) < 4


def test_shirt_stands_round_the_neck_and_stays(shown) -> None:
    rig, regions = shown.rig, shown.rig.neutral.annotations.regions
    cloth, end = rig.vertices[regions["shirt"]], rig.vertices[topology().grid[-1]]
    near = cloth[(cloth[:, 1] - end[:, 1].mean()).abs() < 8]
    middle = end.mean(0)
    assert (near - middle)[:, [0, 2]].norm(dim=1).min() > 0.9 * (end - middle)[:, [0, 2]].norm(dim=1).min()
    assert cloth[:, 1].min() < end[:, 1].min() - 60
    assert rig.deltas[:, regions["shirt"]].abs().max() == 0


def test_closed_parts_and_the_shirt_face_outward(shown) -> None:
    mesh, vertices = shown.rig.neutral, shown.rig.vertices.double()
    part = components(mesh.faces, len(vertices))
    for name in ("teeth_upper", "teeth_lower", "tongue", "hair_locks", "eyeball_left", "eyeball_right", "shirt"):
        faces = mesh.faces[mesh.annotations.regions[name][mesh.faces].all(1)]
        for one in part[faces[:, 0]].unique():
            corners = vertices[faces[part[faces[:, 0]] == one]]
            volume = torch.linalg.det(corners - corners.mean((0, 1))).sum()
            assert float(volume) > 0, name


def test_file_has_images_as_jpeg_and_comes_back(shown, tmp_path) -> None:
    path = tmp_path / "character.glb"
    save_rig(shown.rig, path, shown.surface)
    again = load_rig(path)
    assert again.names == shown.rig.names
    assert (again.vertices - shown.rig.vertices).abs().max() < 1e-4
    content = path.read_bytes()
    assert content.count(b"image/jpeg") == 3
    assert b"metallicRoughnessTexture" in content
    assert path.stat().st_size < 6e6 - 1.6e6  # the images of 2048 texels take 1.5 MB


def test_other_topologies_are_refused(shown) -> None:
    with pytest.raises(TopologyError, match="performer's topology"):
        character(shown.rig)


def test_gums_stay_behind_a_chin_that_lies_further_back() -> None:
    actor = performer(texture=False)
    vertices = actor.vertices.clone()
    vertices[actor.neutral.annotations.regions["chin"], 2] -= 9.0
    shown = character(BlendshapeRig(actor.neutral.with_vertices(vertices), actor.deltas, actor.names), size=64).rig
    regions = shown.neutral.annotations.regions
    face = torch.arange(len(shown.vertices)) < len(vertices)
    outer = face & ~regions["mouth_interior"]
    skin = RayCaster(shown.vertices, shown.neutral.faces[outer[shown.neutral.faces].all(1)])
    gums = shown.vertices[regions["gums_lower"]].double()
    gums = gums[gums[:, 0].abs() < 15]
    assert bool(skin.occluded(gums, gums.new_tensor([0.0, 0.0, 1.0]).expand_as(gums)).all())

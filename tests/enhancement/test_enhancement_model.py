"""What holds of an actor's model: its own frames come back, motion goes along, bad input is told."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from torchface.enhancement import CapturedPerformance, EnhancementModel, EnhancementSettings
from torchface.errors import AlignmentError, TopologyError, TorchfaceError, ValueRangeError
from torchface.geometry.meshes.operators import border_vertices
from torchface.geometry.rotations import rotation_matrix
from torchface.io.meshes.mesh_sequence import MeshSequence, MeshSequenceWriter
from torchface.synthetic.head.performer import performer


def test_a_rigid_motion_of_the_input_moves_the_output_alike(model, database):
    turn, shift = rotation_matrix(torch.tensor([0.3, 0.6, -0.2])), torch.tensor([200.0, -50.0, 400.0])
    still = model(database.smooth[3:6])
    moved = model(database.smooth[3:6] @ turn.T + shift)
    assert torch.allclose(moved, still @ turn.T + shift, atol=1e-3)


def test_frames_of_other_precisions_and_arrays_are_taken(model, database):
    found = model(database.smooth[3:5])
    assert torch.equal(model(database.smooth[3:5].numpy()), found)
    assert float((model(database.smooth[3:5].half()) - found).norm(dim=-1).mean()) < 0.1
    whole = model.low(database.smooth[3:5].round().long())  # whole millimetres
    assert torch.equal(whole, model.low(database.smooth[3:5].round()))
    with pytest.raises(TorchfaceError, match=r"coarse: found the text 'a\.glb', expected a tensor"):
        model("a.glb")


def test_the_neutral_gives_the_neutral(model, database):
    assert float((model(database.neutral[None]) - database.neutral).norm(dim=-1).max()) < 0.01


def test_smooth_frames_get_the_wrinkles_of_the_database(model, database):
    found = model(database.smooth)
    left = (found - database.frames).square().mean().sqrt()
    assert float(left) < 0.4 * float((database.smooth - database.frames).square().mean().sqrt())


def test_frames_of_the_database_come_back(model, database):
    detail = (database.frames - database.smooth).square().sum()
    left = (model(database.frames) - database.frames).square().sum()
    assert float(left) < 0.01 * float(detail)


def test_what_an_input_shows_itself_is_kept_where_pairs_are_known(database):
    paired = EnhancementModel.fit(
        CapturedPerformance(
            database.frames, database.faces, database.sequences, database.neutral, coarse=database.smooth
        ),
        rank=36,
    )
    found = paired(database.smooth)
    given = (database.frames - database.smooth).square().mean().sqrt()
    assert float((found - database.frames).square().mean().sqrt()) < 0.1 * float(given)
    # A mark that no frame of the database has stays, and stays where it is.
    marked = database.smooth[4:5].clone()
    marked[0, 2000, 2] += 2.0
    assert float((paired(marked) - found[4:5])[0, 2000, 2]) == pytest.approx(2.0, abs=0.1)


def test_outside_the_database_detail_is_told_and_stays_bounded(model, database):
    smooth = copy.deepcopy(model)
    smooth.coefficients = torch.zeros_like(model.coefficients)
    largest = (database.frames - smooth(database.frames)).norm(dim=-1).max()
    extreme = database.smooth[13:14] - database.neutral
    assert not bool(model.enhance(database.neutral + extreme).outside.any())
    for factor, bound in ((2.0, 1.6), (3.0, 1.4), (8.0, 1.2)):  # nearer to what the database has the further away
        far = database.neutral + factor * extreme
        found = model.enhance(far)
        assert float(found.outside.float().mean()) > 0.5
        assert float((found.vertices - smooth(far)).norm(dim=-1).max()) < bound * float(largest)


def test_an_expression_that_the_database_never_shows_is_told(model, database):
    rig = performer(texture=False)
    for name in ("jawOpen", "browDownLeft", "mouthSmileLeft"):
        shown = database.neutral + rig.deltas[rig.names.index(name)]
        assert bool(model.enhance(shown[None]).outside.any()), name


def test_a_model_of_an_earlier_version_is_refused(model):
    lacking = {name: value for name, value in model.config.items() if name != "scale"}
    for config in (lacking, {**model.config, "limits": [0.5]}, {**model.config, "weight_names": ["jawOpen"]}):
        with pytest.raises(ValueRangeError, match="earlier version, whose state was another: learn it again"):
            EnhancementModel.from_config(config)


def test_a_state_out_of_range_is_refused(model):
    wrong = {"limits": 0.0, "map_shares": 1.5, "region_weights": 0.0, "database_features": 1e30, "coefficients": 1e38}
    for name, value in wrong.items():
        broken = copy.deepcopy(model)
        getattr(broken, name)[0] = value
        with pytest.raises(ValueRangeError, match=f"{name}: found"):
            broken.check_state()
    for name, value in (
        ("region_names", [1]),
        ("region_names", ["../a"]),
        ("voluntary", [[]]),
        ("keeps_input", "no"),
        ("scale", 1e300),
    ):
        with pytest.raises(ValueRangeError, match=name):
            EnhancementModel.from_config({**model.config, name: value})


def test_another_actor_gets_the_detail_in_its_own_place_and_scale(model, database):
    given, turn = database.smooth[13:14], rotation_matrix(torch.tensor([0.2, -0.5, 0.1]))
    found = model(given)
    assert float((found - given).norm(dim=-1).max()) > 1
    turned = model.on_actor(database.neutral @ turn.T)(given @ turn.T)
    assert float((turned - found @ turn.T).norm(dim=-1).max()) < 2e-3
    large = model.on_actor(1.1 * database.neutral)(1.1 * given)
    assert float((large - 1.1 * found).norm(dim=-1).max()) < 2e-3
    half = model.on_actor(1.1 * database.neutral, 0.5)(1.1 * given)
    assert torch.allclose(half, 0.5 * (large + 1.1 * given), atol=1e-3)
    assert torch.allclose(model.on_actor(database.neutral, 0.0)(given), given, atol=1e-3)


def test_colours_blend_as_the_detail_does(database):
    shades = torch.rand(4, 1, 3).repeat_interleave(9, dim=0).expand(-1, len(database.neutral), -1)
    colored = EnhancementModel.fit(
        CapturedPerformance(database.frames, database.faces, database.sequences, database.neutral, colors=shades),
        rank=4,
    )
    weights = torch.zeros(1, len(colored.region_names), 36)
    weights[..., 20] = 1.0
    assert torch.allclose(colored.colors(weights)[0], shades[20], atol=5e-3)
    weights[..., 20], weights[..., 2] = 0.5, 0.5
    assert torch.allclose(colored.colors(weights)[0], 0.5 * (shades[20] + shades[2]), atol=5e-3)


def test_derivatives_are_those_of_finite_differences(model, database):
    own = copy.deepcopy(model)
    given = (0.7 * database.smooth[4:5] + 0.3 * database.smooth[13:14]).double().requires_grad_(True)
    looked_at = torch.randn(given.shape, generator=torch.Generator().manual_seed(0)).double()
    step = 1e-4 * (database.smooth[22:23] - database.neutral).double()
    (own(given) * looked_at).sum().backward()
    with torch.no_grad():
        ahead, behind = ((own(given + sign * step) * looked_at).sum() for sign in (1, -1))
    assert float((given.grad * step).sum()) == pytest.approx(float(ahead - behind) / 2, rel=0.02)


def test_gradients_of_triangles_as_detail_find_nearly_the_same(model, database):
    given = database.frames, database.faces, database.sequences, database.neutral
    projected = copy.deepcopy(model)
    projected.settings = replace(projected.settings, matching="projection")
    other = EnhancementModel.fit(
        CapturedPerformance(*given),
        EnhancementSettings(detail="gradients", matching="projection"),
        rank=36,
        patch_size=20,
    )
    left = other(database.smooth[3:6]) - projected(database.smooth[3:6])
    detail = (database.frames - database.smooth)[3:6]
    assert float(left.square().mean().sqrt()) < 0.3 * float(detail.square().mean().sqrt())


def test_a_run_that_is_killed_continues_to_the_same_model(database, tmp_path, monkeypatch):
    monkeypatch.setattr("torchface.enhancement.enhancement_training._SECONDS", 0.0)
    monkeypatch.setattr("torchface.enhancement.enhancement_training._LARGEST_BLOCK", 5)
    given = database.frames, database.faces, database.sequences, database.neutral
    whole = EnhancementModel.fit(CapturedPerformance(*given), rank=6, patch_size=20)
    steps = []

    def killed(step, done=0, total=0):
        steps.append(done)
        if done == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        EnhancementModel.fit(CapturedPerformance(*given), rank=6, patch_size=20, folder=tmp_path, progress=killed)
    first, steps = steps, []
    again = EnhancementModel.fit(
        CapturedPerformance(*given),
        rank=6,
        patch_size=20,
        folder=tmp_path,
        progress=lambda step, done=0, total=0: steps.append(done),
    )
    assert max(first) == 20
    assert min(done for done in steps if done) == 20
    kept = zip(whole.state_dict().values(), again.state_dict().values(), strict=True)
    assert all(torch.equal(one, two) for one, two in kept)
    assert list(tmp_path.iterdir()) == []


def test_frames_on_disk_give_the_same_model(model, database, tmp_path):
    with MeshSequenceWriter(tmp_path / "frames.safetensors", 36, len(database.neutral), database.faces) as writer:
        writer.append(database.frames)
    sequence = MeshSequence(tmp_path / "frames.safetensors")
    found = EnhancementModel.fit(
        CapturedPerformance(sequence, database.faces, database.sequences, database.neutral), rank=36, patch_size=20
    )
    assert torch.equal(found(database.smooth[3:5]), model(database.smooth[3:5]))


def test_what_is_not_of_this_mesh_or_unit_is_refused(model, database):
    with pytest.raises(TopologyError, match=r"found \(1, 100, 3\), expected \(T,"):
        model(torch.zeros(1, 100, 3))
    with pytest.raises(AlignmentError, match="10 times as large as the neutral"):
        model(10 * database.smooth[2:4])
    with pytest.raises(TopologyError, match="another order"):
        model(database.smooth[2:4, torch.randperm(len(database.neutral))])
    broken = database.smooth[2:4].clone()
    broken[1, 7] = math.nan
    with pytest.raises(ValueRangeError, match="frame 1 holds NaN"):
        model(broken)


def test_a_database_that_cannot_be_learned_from_is_told(database):
    def fit(frames=database.frames, sequences=database.sequences):
        return EnhancementModel.fit(CapturedPerformance(frames, database.faces, sequences, database.neutral), rank=4)

    broken = database.frames.clone()
    broken[5, 7] = math.nan
    with pytest.raises(ValueRangeError, match="frame 5 holds NaN"):
        fit(broken)
    with pytest.raises(ValueRangeError, match="4 sequences in 36 pieces"):
        fit(sequences=torch.arange(36) % 4)
    with pytest.raises(TopologyError, match=r"expected \(K,"):
        fit(database.frames[:, :-1])
    with pytest.warns(UserWarning, match="found 1 of 36 frames"):
        fit(sequences=torch.zeros(36, dtype=torch.int64))
    with pytest.warns(UserWarning, match=r"nearer to the neutral than \d"):
        fit(database.frames[12:15], torch.tensor([0, 0, 1]))


def test_a_loose_eye_and_a_vertex_of_no_triangle_come_through_as_they_are(database):
    ball = torch.tensor([[0.0, 0, 5], [5, 0, 0], [0, 5, 0], [-5, 0, 0], [0, -5, 0]])
    sides = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    count, place = len(database.neutral), torch.tensor([30.0, 30.0, 90.0])

    def with_ball(vertices, turn=0.0):
        turned = ball @ rotation_matrix(torch.tensor([0.0, turn, 0.0])).T + place
        loose = torch.cat([turned, place[None] + 20]).expand(len(vertices), -1, -1)
        return torch.cat([vertices, loose], dim=1)

    faces = torch.cat([database.faces, sides + count])
    own = EnhancementModel.fit(
        CapturedPerformance(
            with_ball(database.frames), faces, database.sequences, with_ball(database.neutral[None])[0]
        ),
        rank=8,
    )
    asked = with_ball(database.smooth[4:5], 0.4)
    found = own(asked)
    assert torch.allclose(found[0, count:], asked[0, count:], atol=0.02)
    assert bool(torch.isfinite(found).all())


def test_borders_of_eyes_and_mouth_stay_where_the_database_has_them(model, database):
    border = border_vertices(database.faces, len(database.neutral))
    assert int(border.sum()) > 20
    found = model(database.frames[13:14])
    assert float((found - database.frames[13:14])[0, border].norm(dim=1).max()) < 0.05


def test_flicker_of_weights_found_frame_by_frame_is_damped(model, database):
    even = torch.linspace(0.3, 0.8, 16)
    truth = database.neutral + even[:, None, None] * (database.smooth[4] - database.neutral)
    generator = torch.Generator().manual_seed(0)
    shaken = 0.06 * torch.randn(16, 3, generator=generator)
    noise = torch.einsum("tn,nvc->tvc", shaken, database.smooth[[13, 22, 31]] - database.neutral)
    held = copy.deepcopy(model)
    held.settings = replace(held.settings, temporal=0.3)
    clean = model.enhance(truth)
    flicker, lag = [], []
    for some in (model, held):
        found = some.enhance(truth + noise)
        flicker.append(float((found.weights - clean.weights).diff(n=2, dim=0).square().mean().sqrt()))
        lag.append(float((found.vertices - noise - clean.vertices).square().mean().sqrt()))
    assert flicker[1] < 0.6 * flicker[0]
    assert lag[1] < 1.1 * lag[0]

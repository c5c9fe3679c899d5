"""Morphable models against scikit-learn, planted coefficients, and their own definition."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from sklearn.decomposition import PCA

from torchface import zoo
from torchface.errors import FileFormatError, ShapeError, TopologyError, ValueRangeError
from torchface.io import load_identity_modes
from torchface.modeling import HeadModel, MorphableModel
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, neutral_head


def heads(count: int, seed: int = 0) -> torch.Tensor:
    identities = draw_identities(count, torch.Generator().manual_seed(seed))
    return torch.stack([neutral_head(identity, texture=False).vertices for identity in identities])


@pytest.fixture(scope="module")
def samples() -> torch.Tensor:
    return heads(14)


@pytest.fixture(scope="module")
def model(samples: torch.Tensor) -> MorphableModel:
    return MorphableModel.fit(samples)


def test_the_same_as_scikit_learn(samples: torch.Tensor, model: MorphableModel) -> None:
    peer = PCA(svd_solver="full").fit(samples.flatten(1).double().numpy())
    theirs = torch.from_numpy(peer.explained_variance_[: model.count]).sqrt()
    assert model.count == 13
    assert ((model.standard_deviations.double() - theirs).abs() / theirs).max() < 1e-5
    along = model.components.flatten(1).double() @ torch.from_numpy(peer.components_[:13]).T
    assert (along.abs() - torch.eye(13, dtype=torch.float64)).abs().max() < 1e-4
    assert (model.mean.flatten() - torch.from_numpy(peer.mean_)).abs().max() < 1e-4
    assert float(model.total_variance) == pytest.approx(peer.explained_variance_.sum(), rel=1e-5)
    few = PCA(5, svd_solver="full").fit(samples.flatten(1).double().numpy())
    assert torch.allclose(
        MorphableModel.fit(samples, 5).explained, torch.from_numpy(few.explained_variance_ratio_).cumsum(0), rtol=1e-5
    )


@pytest.mark.real
def test_real_modes_are_found_again(ict_folder: Path) -> None:
    modes = load_identity_modes(ict_folder, part="face")
    drawn = torch.randn(60, len(modes.names), generator=torch.Generator().manual_seed(1))
    faces = torch.stack([modes.head(row).vertices for row in drawn])
    learned = MorphableModel.fit(faces)
    assert learned.count == len(modes.names)  # what rounding adds is no component
    assert (learned(learned.project(faces)) - faces).abs().max() < 1e-3
    other = modes.random_head(7).vertices
    assert (learned(learned.project(other[None]))[0] - other).abs().max() < 1e-3


def test_components_do_not_depend_on_the_order_of_samples(samples: torch.Tensor, model: MorphableModel) -> None:
    again = MorphableModel.fit(samples.flip(0))
    assert (again.components - model.components).abs().max() < 1e-4
    assert torch.equal(MorphableModel.fit(samples).components, model.components)


def test_samples_come_back_from_their_coefficients(samples: torch.Tensor, model: MorphableModel) -> None:
    coefficients = model.project(samples)
    assert (model(coefficients) - samples).abs().max() < 1e-3
    assert torch.allclose(coefficients.mean(0), torch.zeros(13), atol=1e-4)
    assert torch.allclose(coefficients.std(0), torch.ones(13), atol=1e-4)


def test_few_vertices_tell_the_coefficients_they_can(model: MorphableModel) -> None:
    truth = model.sample(3, torch.Generator().manual_seed(2))
    ids = torch.arange(0, len(model.mean), 40)
    assert (model.project(model(truth)[:, ids], ids) - truth).abs().max() < 1e-2
    # Two vertices cannot tell thirteen coefficients: the shortest ones that explain them.
    two = torch.tensor([10, 3000])
    short = model.project(model(truth)[:, two], two)
    assert (model(short)[:, two] - model(truth)[:, two]).abs().max() < 1e-2
    assert (short.norm(dim=1) < truth.norm(dim=1)).all()


def test_missing_vertices_are_those_not_named(model: MorphableModel) -> None:
    faces = model(model.sample(4, torch.Generator().manual_seed(3)))
    ids = torch.arange(0, len(model.mean), 25)
    holed = torch.full_like(faces, float("nan"))
    holed[:2, ids] = faces[:2, ids]
    holed[2:] = faces[2:]
    found = model.project(holed, noise=0.5)
    assert torch.allclose(found[:2], model.project(faces[:2, ids], ids, noise=0.5), atol=1e-5)
    assert torch.allclose(found[2:], model.project(faces[2:], noise=0.5), atol=1e-5)
    assert model.project(torch.full_like(faces[:1], float("nan")), noise=1.0).abs().max() == 0


@pytest.mark.parametrize("noise", [None, 0.5])
def test_a_model_in_double_precision_projects_in_it(model: MorphableModel, noise: float | None) -> None:
    double = copy.deepcopy(model).double()
    wanted = double.sample(3, torch.Generator().manual_seed(1))
    found = double.project(double(wanted), noise=noise)
    assert found.dtype == torch.float64
    if noise is None:
        torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
    faces = double(wanted)
    faces[1, 7, 0] = torch.inf
    with pytest.raises(ValueRangeError, match=r"infinity in rows \[1\]"):
        double.project(faces, noise=noise)


def test_noise_gives_the_mean_of_the_posterior(model: MorphableModel) -> None:
    generator = torch.Generator().manual_seed(4)
    ids = torch.arange(7, len(model.mean), 400)
    seen = model(model.sample(1, generator))[:, ids] + torch.randn(1, len(ids), 3, generator=generator)
    noise = torch.linspace(0.5, 3, len(ids), dtype=torch.float64)
    coefficients = model.project(seen, ids, noise).double().requires_grad_()
    expected = model.mean[ids].double() + torch.tensordot(coefficients, model.modes[:, ids].double(), 1)
    energy = ((seen - expected) / noise[:, None]).square().sum() / 2 - model.log_prob(coefficients).sum()
    (gradient,) = torch.autograd.grad(energy, coefficients)
    assert gradient.abs().max() < 1e-3
    truths = model.sample(40, generator)
    few = torch.tensor([50, 900, 2500, 4000])
    noisy = model(truths)[:, few] + 2.0 * torch.randn(40, 4, 3, generator=generator)
    off = [(model.project(noisy, few, n) - truths).square().mean() for n in (None, 0.1, 2.0, 50.0)]
    assert min(off) == off[2]  # the noise that is there is the best guess


def test_log_prob_and_samples_are_those_of_a_normal_distribution(model: MorphableModel) -> None:
    drawn = model.sample(4000, torch.Generator().manual_seed(5))
    normal = torch.distributions.MultivariateNormal(torch.zeros(13), torch.eye(13))
    constant = normal.log_prob(torch.zeros(13))
    assert torch.allclose(model.log_prob(drawn), normal.log_prob(drawn) - constant, atol=1e-4)
    assert torch.allclose(drawn.T.cov(), torch.eye(13), atol=0.1)
    assert torch.equal(drawn, model.sample(4000, torch.Generator().manual_seed(5)))


def test_a_morph_goes_straight(model: MorphableModel) -> None:
    ends = model.sample(2, torch.Generator().manual_seed(6))
    faces = model(model.interpolate(ends[0], ends[1], 5))
    assert torch.allclose(faces[[0, 4]], model(ends), atol=1e-4)
    assert torch.allclose(faces[1], 0.75 * faces[0] + 0.25 * faces[4], atol=1e-3)


def test_truncation_keeps_what_it_says(samples: torch.Tensor, model: MorphableModel) -> None:
    part = model.truncate(variance=0.9)
    assert part.explained[-1] >= 0.9 > part.explained[-2]
    left = (samples - part(part.project(samples))).double().square().sum() / 13
    assert float(left) == pytest.approx(float((1 - part.explained[-1]) * model.total_variance), rel=1e-3)
    assert model.truncate(3).count == 3
    assert model.truncate(variance=1.0).count == 13
    with pytest.raises(ValueRangeError, match=r"found 0.99.*at most 0\.9"):
        part.truncate(variance=0.9999)
    with pytest.raises(ValueRangeError, match="found 14, expected a whole number from 1 to 13"):
        model.truncate(14)


def test_a_model_is_rebuilt_from_config_and_state(samples: torch.Tensor, model: MorphableModel) -> None:
    template = neutral_head(texture=False)
    color = MorphableModel.fit(torch.rand(5, len(template.vertices), 3, generator=torch.Generator().manual_seed(7)))
    whole = HeadModel.on(template, model, color)
    again = HeadModel.from_config(json.loads(json.dumps(whole.config)))
    again.load_state_dict(whole.state_dict())
    a, b = model.project(samples[:1])[0], color.sample(1, torch.Generator().manual_seed(8))[0]
    ours, theirs = again.mesh(a, b), whole.mesh(a, b)
    assert torch.equal(ours.vertices, theirs.vertices)
    assert torch.equal(ours.colors, theirs.colors)
    assert torch.equal(ours.landmarks, template.landmarks)
    assert torch.equal(ours.annotations.regions["nose"], template.annotations.regions["nose"])
    assert ours.fingerprint() == template.fingerprint()
    assert (ours.vertices - samples[0]).abs().max() < 1e-3
    plain = HeadModel(model, None, template.faces)
    assert HeadModel.from_config(plain.config).state_dict().keys() == plain.state_dict().keys()
    with pytest.raises(TopologyError, match="has no colours"):
        plain(a[None], b[None])


@pytest.mark.parametrize(
    "change", [{"vertices": 0}, {"components": True}, {"channels": "3"}, {"vertices": 2**30}, {"samples": None}]
)
def test_configs_that_make_no_model_are_refused(model: MorphableModel, change: dict) -> None:
    with pytest.raises(FileFormatError):
        MorphableModel.from_config({**model.config, **change})


def test_samples_that_teach_nothing_are_refused(samples: torch.Tensor) -> None:
    with pytest.raises(ShapeError, match="found 1, expected at least two"):
        MorphableModel.fit(samples[:1])
    with pytest.raises(ValueRangeError, match="found 3 that are all the same"):
        MorphableModel.fit(samples[:1].expand(3, -1, -1))
    with pytest.raises(ValueRangeError, match="of 14 samples: found 14, expected a whole number from 1 to 13"):
        MorphableModel.fit(samples, 14)
    with pytest.raises(ValueRangeError, match=r"found 5, expected at most 3.*duplicates"):
        MorphableModel.fit(torch.cat([samples[:4], samples[:4]]), 5)
    assert MorphableModel.fit(torch.cat([samples[:4], samples[:4]])).count == 3
    broken = samples.clone()
    broken[2, 5, 1] = float("nan")
    with pytest.raises(ValueRangeError, match="number 2 holds NaN"):
        MorphableModel.fit(broken)
    with pytest.raises(ShapeError, match=r"expected \(B,10,3\)"):
        MorphableModel.fit(samples).project(samples, torch.arange(10))
    with pytest.raises(ValueRangeError, match="noise: found 0"):
        MorphableModel.fit(samples[:3]).project(samples, noise=0)


def test_coefficients_are_differentiated_through(model: MorphableModel) -> None:
    a = torch.randn(2, 13, generator=torch.Generator().manual_seed(9), dtype=torch.float64, requires_grad=True)
    small = MorphableModel(model.mean[:4], model.components[:, :4], model.standard_deviations)
    assert torch.autograd.gradcheck(small, a)


def test_a_part_of_a_model_draws_the_same_heads(dome_rig: BlendshapeRig) -> None:
    model = MorphableModel(dome_rig.vertices, torch.nn.functional.normalize(dome_rig.deltas, dim=(1, 2)), torch.ones(4))
    keep = dome_rig.vertices[:, 1] > 10
    ids = keep.nonzero()[:, 0]
    part = HeadModel.on(dome_rig.neutral, model, rig=dome_rig).part(keep)
    basis = part.shape.components.flatten(1)
    torch.testing.assert_close(basis @ basis.T, torch.eye(len(basis)), rtol=0, atol=1e-5)
    whole, cut = (m.modes.flatten(1).double() for m in (model, part.shape))
    columns = (3 * ids[:, None] + torch.arange(3)).flatten()
    torch.testing.assert_close(cut.T @ cut, (whole.T @ whole)[columns][:, columns], rtol=0, atol=1e-6)
    torch.testing.assert_close(part.rig.deltas, dome_rig.deltas[:, ids])
    assert torch.equal(model.part(keep).components, model.part(ids).components)
    for nothing in (ids[:0], torch.zeros_like(keep)):
        with pytest.raises(ValueRangeError, match="vertices: found none, expected at least one"):
            model.part(nothing)


def test_a_rig_travels_with_a_head_model(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    people = dome_rig.vertices + torch.randn(6, *dome_rig.vertices.shape, generator=torch.Generator().manual_seed(0))
    elsewhere = BlendshapeRig(dome_rig.neutral.with_vertices(dome_rig.vertices + 5), dome_rig.deltas, dome_rig.names)
    model = HeadModel.on(dome_rig.neutral, MorphableModel.fit(people), rig=elsewhere)
    zoo.save_model(model, tmp_path / "heads", zoo.ModelCard("MIT", "noise", {}, "none"))
    again = zoo.get_model(tmp_path / "heads").rig
    assert again.names == elsewhere.names
    assert torch.equal(again.deltas, elsewhere.deltas)
    assert torch.equal(again.vertices, elsewhere.vertices)
    assert again.neutral.fingerprint() == elsewhere.neutral.fingerprint()
    text = (tmp_path / "heads" / "model.toml").read_text()
    (tmp_path / "heads" / "model.toml").write_text(text.replace('"jawOpen"', "7"))
    with pytest.raises(FileFormatError, match=r"found rig.shapes\[0\] = 7, expected text"):
        zoo.get_model(tmp_path / "heads")
    other = replace(dome_rig.neutral, faces=dome_rig.neutral.faces.flip(0), polygons=None)
    with pytest.raises(TopologyError, match="found a rig of 625 vertices and 1152 triangles, expected the heads' 625"):
        HeadModel.on(other, MorphableModel.fit(people), rig=elsewhere)

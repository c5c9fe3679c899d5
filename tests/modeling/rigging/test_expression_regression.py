"""Expressions from a neutral face: planted laws come back, pose does not matter, identity does not leak."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from sklearn.decomposition import PCA
from sklearn.linear_model import LinearRegression, Ridge
from torch import Tensor

from torchface import BlendshapeRig, load_rig, zoo
from torchface.errors import NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.modeling import (
    ExpressionRegression,
    ExpressionSettings,
    neutral_rig,
    rig_from_neutral,
    transfer_deformation,
)
from torchface.modeling.rigging.expression_training import choose_components
from torchface.onnx.expression_graph import OffsetRegression
from torchface.synthetic import draw_identities, performer

V = 40
SHOWN = ["jawOpen", "mouthClose", "mouthSmileLeft"]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def turned(points: Tensor, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Points (V,3) after a large rigid move, and its rotation."""
    rotation = torch.linalg.qr(noise(3, 3, seed=seed).double())[0]
    rotation = (rotation * torch.linalg.det(rotation)).to(points)
    return points @ rotation.T + torch.tensor([30.0, -400, 90]).to(points), rotation


@pytest.fixture(scope="module")
def performers() -> list[BlendshapeRig]:
    """Seven heads with three shapes."""
    identities = draw_identities(7, torch.Generator().manual_seed(4))
    return [performer(identity, texture=False).select(SHOWN) for identity in identities]


@pytest.fixture(scope="module")
def people() -> tuple[Tensor, Tensor]:
    """24 people whose two expressions are linear in four ways in which their neutrals differ; vertex 0 stays still."""
    mean, ways = 50 * noise(V, 3), noise(4, V, 3, seed=1)
    who = noise(24, 4, seed=2) * torch.tensor([6.0, 4, 3, 2])
    neutrals = (mean + torch.einsum("mk,kvc->mvc", who, ways)).double()
    law, usual = 0.2 * noise(4, 2, V, 3, seed=3), 5 * noise(2, V, 3, seed=4)
    offsets = usual + torch.einsum("mk,knvc->mnvc", who, law)
    offsets[:, :, 0] = 0.0
    return neutrals, neutrals[:, None] + offsets


def test_a_planted_law_comes_back_on_new_people(people: tuple[Tensor, Tensor]) -> None:
    neutrals, expressions = people
    model = ExpressionRegression.fit(neutrals[:20], expressions[:20])
    found = model(neutrals[20:])
    assert found.shape == (4, 2, V, 3)
    left = (found - expressions[20:]).norm(dim=-1).mean()
    of_mean = (expressions - neutrals[:, None])[:20].mean(0)
    assert left < 0.05 * (neutrals[20:, None] + of_mean - expressions[20:]).norm(dim=-1).mean()


def test_what_is_small_is_predicted_from_its_own_form_beside_what_is_large() -> None:
    """Jaws differ by far more, and in more ways, than there are components; blinks follow from the lids alone."""
    mean, jaw, lids = 50 * noise(120, 3), slice(0, 100), slice(100, 110)
    forms, lid_forms = noise(60, 20, seed=1), noise(60, 2, seed=2)
    neutrals = mean.expand(60, -1, -1).clone()
    neutrals[:, jaw] += 3 * torch.einsum("mk,kvc->mvc", forms, noise(20, 100, 3, seed=3))
    neutrals[:, lids] += 0.3 * torch.einsum("mk,kvc->mvc", lid_forms, noise(2, 10, 3, seed=4))
    offsets = torch.zeros(60, 2, 120, 3)
    offsets[:, 0, jaw] = 10 + torch.einsum("mk,kvc->mvc", forms, noise(20, 100, 3, seed=5))
    offsets[:, 1, lids] = 5 + torch.einsum("mk,kvc->mvc", lid_forms, noise(2, 10, 3, seed=6))
    model = ExpressionRegression.fit(neutrals[:50], neutrals[:50, None] + offsets[:50], names=["jaw", "blink"])
    wrong = (model.offsets(neutrals[50:]) - offsets[50:])[:, 1].square().sum()
    assert wrong < 0.02 * (offsets[:50].mean(0) - offsets[50:])[:, 1].square().sum()


def test_what_never_moves_stays_exactly(people: tuple[Tensor, Tensor]) -> None:
    neutrals, expressions = people
    model = ExpressionRegression.fit(neutrals, expressions)
    assert len(model.places) == 2 * (V - 1)
    assert torch.equal(model(neutrals.float())[:, :, 0], neutrals.float()[:, None, 0].expand(-1, 2, -1))


@pytest.mark.parametrize("ridge", [0.0, 0.1])
def test_agrees_with_scikit_learn(people: tuple[Tensor, Tensor], ridge: float) -> None:
    neutrals, expressions = people
    expressions = expressions + 0.5 * noise(*expressions.shape, seed=5)
    neutrals = neutrals + 0.5 * noise(*neutrals.shape, seed=6)
    model = ExpressionRegression.fit(
        neutrals[:20],
        expressions[:20],
        ExpressionSettings(neutral_components=6, offset_components=5, ridge=ridge),
        region=torch.ones(V) > 0,
    )
    # The reference gets the people aligned with each other, the rest is its own.
    laid = neutrals.clone()
    for i in range(len(neutrals)):
        pose = model_pose(model, neutrals[i])
        laid[i] = neutrals[i] @ pose.T
        expressions[i] = expressions[i] @ pose.T
    X = laid.flatten(1) - laid.reshape(len(laid), V, 3).mean(1).repeat(1, V)
    inner = PCA(6).fit(X[:20])
    scores = inner.transform(X[:20])
    strength = ridge * (scores**2).sum() / 6
    expected = []
    for offsets in (expressions - laid[:, None]).flatten(2).unbind(1):
        outer = PCA(5).fit(offsets[:20])
        line = Ridge(strength, fit_intercept=False) if ridge else LinearRegression(fit_intercept=False)
        line.fit(scores, outer.transform(offsets[:20]))
        expected.append(torch.from_numpy(outer.inverse_transform(line.predict(inner.transform(X[20:])))))
    expected = torch.cat(expected, 1)
    found = torch.stack([model.offsets(laid[i : i + 1])[0] for i in range(20, 24)]).flatten(1)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))


def model_pose(model: ExpressionRegression, neutral: Tensor) -> Tensor:
    """The rotation that lays a neutral onto the model's mean, by Kabsch's method."""
    a, b = neutral - neutral.mean(0), model.neutral_mean.double() - model.neutral_mean.double().mean(0)
    u, _, vh = torch.linalg.svd(b.T @ a)
    return u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vh))]).double()) @ vh


def test_the_head_may_have_any_pose(people: tuple[Tensor, Tensor]) -> None:
    neutrals, expressions = people
    model = ExpressionRegression.fit(neutrals, expressions)
    moved, rotation = turned(neutrals[3])
    expected = model.offsets(neutrals[3:4]) @ rotation.T
    torch.testing.assert_close(model.offsets(moved[None]), expected, rtol=0, atol=1e-9)
    # Nor need those have the same pose whom it learns from.
    pairs = [turned(torch.cat([n[None], e]), seed)[0] for seed, (n, e) in enumerate(zip(*people, strict=True))]
    mixed = ExpressionRegression.fit(torch.stack([p[0] for p in pairs]), torch.stack([p[1:] for p in pairs]))
    torch.testing.assert_close(mixed.offsets(neutrals[3:4]), model.offsets(neutrals[3:4]), rtol=0, atol=1e-3)


def test_gradients_go_through(people: tuple[Tensor, Tensor]) -> None:
    model = ExpressionRegression.fit(*people, ExpressionSettings(neutral_components=3, offset_components=3)).double()
    neutral = people[0][:1].clone().requires_grad_()
    weight = noise(1, 2, V, 3, seed=9).double()
    assert torch.autograd.gradcheck(lambda n: (model(n) * weight).sum(), neutral, atol=1e-4, rtol=1e-3)


def test_the_first_form_of_the_thesis_leaks_identity(performers: list[BlendshapeRig]) -> None:
    """Equation 31: nothing should move behind the ears in a smile, but the head that comes back is another's."""
    neutrals = torch.stack([rig.vertices for rig in performers])
    smiles = torch.stack([rig.select(["mouthSmileLeft"])(torch.ones(1, 1)) for rig in performers])
    left = {}
    for form in ("offsets", "expressions"):
        model = ExpressionRegression.fit(neutrals[:6], smiles[:6], ExpressionSettings(form=form))
        still = (smiles - neutrals[:, None]).abs().amax((0, 1, 3)) == 0
        left[form] = (model(neutrals[6:]) - neutrals[6:, None])[0, 0, still].norm(dim=-1).mean()
    assert left["offsets"] == 0
    assert left["expressions"] > 0.5


def test_components_are_chosen_as_one_by_one_would_choose(people: tuple[Tensor, Tensor]) -> None:
    neutrals, expressions = people
    offsets = (expressions - neutrals[:, None] + 0.5 * noise(*expressions.shape, seed=8)).flatten(1)[:9]
    inputs = (neutrals + noise(*neutrals.shape, seed=7)).flatten(1)[:9]
    for ridge in (0.0, 0.1):
        errors = torch.zeros(7, 7, dtype=torch.float64)
        for i in range(9):
            rest = torch.arange(9) != i
            mean, middle = inputs[rest].mean(0), offsets[rest].mean(0)
            inner = torch.linalg.svd(inputs[rest] - mean, full_matrices=False)[2]
            outer = torch.linalg.svd(offsets[rest] - middle, full_matrices=False)[2]
            for k in range(7):
                scores = (inputs[rest] - mean) @ inner[: k + 1].T
                gram = scores.T @ scores
                gram = gram + ridge * gram.diagonal().mean() * torch.eye(k + 1)
                line = torch.linalg.solve(gram, scores.T @ (offsets[rest] - middle))
                told = ((inputs[i] - mean) @ inner[: k + 1].T) @ line
                for j in range(7):
                    error = middle + told @ outer[: j + 1].T @ outer[: j + 1] - offsets[i]
                    errors[k, j] += error.square().sum()
        found = choose_components(inputs, offsets, ridge=ridge)
        k, j = divmod(int(errors.argmin()), 7)
        assert (found.inputs, found.outputs) == (k + 1, j + 1)
        assert abs(found.error - float(errors.min())) < 1e-6 * float(errors.min())
        fixed = choose_components(inputs, offsets, 3, 2, ridge)
        assert abs(fixed.error - float(errors[2, 1])) < 1e-6 * float(errors[2, 1])


def test_what_is_chosen_predicts_better_than_too_many(people: tuple[Tensor, Tensor]) -> None:
    neutrals, expressions = people
    seen = neutrals + 2.0 * noise(24, V, 3, seed=6)
    shown = seen[:, None] + (expressions - neutrals[:, None]) + 2.0 * noise(*expressions.shape, seed=5)
    error = {}
    for name, asked in {"chosen": (None, None, None), "default": (14, 13, 0.0)}.items():
        model = ExpressionRegression.fit(seen[:16], shown[:16], ExpressionSettings(*asked))
        error[name] = (model.offsets(seen[16:]) - (expressions - neutrals[:, None])[16:]).square().sum()
    assert error["chosen"] < 0.8 * error["default"]


def test_a_rig_is_predicted_where_it_can_be_and_transferred_elsewhere(performers: list[BlendshapeRig]) -> None:
    learned = ["mouthSmileLeft", "jawOpen"]
    neutrals = torch.stack([rig.vertices for rig in performers[:6]])
    faces = torch.stack([rig.select(learned)(torch.eye(2)) for rig in performers[:6]])
    topology = performers[0].neutral.fingerprint()
    model = ExpressionRegression.fit(neutrals, faces, names=learned, topology=topology)
    template = performer(texture=False).select(SHOWN)
    made = rig_from_neutral(model, template, performers[6].neutral)
    assert made.names == tuple(SHOWN)
    transferred = transfer_deformation(template, performers[6].neutral)
    assert torch.equal(made.deltas[1], transferred.deltas[1])
    predicted = model.offsets(performers[6].vertices[None])[0]
    assert torch.equal(made.deltas[[2, 0]], predicted)
    whole = rig_from_neutral(model, template.select(learned), performers[6].neutral)
    assert torch.equal(whole.deltas, predicted)

    with pytest.raises(TopologyError, match="topology"):
        rig_from_neutral(
            model, template, replace(performers[6].neutral, faces=performers[6].neutral.faces.flip(1), polygons=None)
        )
    with pytest.raises(NameMismatchError, match="found a regression of mouthSmileLeft"):
        rig_from_neutral(model, template.select(["mouthClose"]), performers[6].neutral)


def test_a_rig_of_other_names_is_predicted_too(performers: list[BlendshapeRig]) -> None:
    """Other spellings are the same shapes; the halves of a whole add up to it, and split it as transfer does."""
    names = ("jawOpen", "mouthClose", "mouthSmileLeft")
    neutrals = torch.stack([rig.vertices for rig in performers])
    shown = torch.stack([rig.vertices + rig.select(names).deltas for rig in performers])
    model = ExpressionRegression.fit(neutrals[:6], shown[:6], names=names)
    template = performers[0].select(names)
    left = template.vertices[:, 0] < 0
    lips = template.deltas[1]
    halves = torch.stack([torch.where(left[:, None], lips, 0.0), torch.where(left[:, None], 0.0, lips)])
    other = BlendshapeRig(
        template.neutral,
        torch.cat([template.deltas[[2, 0]], halves]),
        ("mouthSmile_L", "JawOpen", "mouthClose_L", "mouthClose_R"),
    )
    made = rig_from_neutral(model, other, performers[6].neutral)
    whole = rig_from_neutral(model, template, performers[6].neutral)
    assert made.names == other.names
    torch.testing.assert_close(made.deltas[:2], whole.deltas[[2, 0]])
    torch.testing.assert_close(made.deltas[2:].sum(0), whole.deltas[1], rtol=0, atol=1e-3)
    middle = template.vertices[:, 0].abs() > 8
    assert made.deltas[2][middle & ~left].norm(dim=1).max() < 0.05 * whole.deltas[1].norm(dim=1).max()


def test_awkward_people(people: tuple[Tensor, Tensor]) -> None:
    neutrals, expressions = people
    few = ExpressionRegression.fit(neutrals[:3], expressions[:3])
    assert (len(few.neutral_components), len(few.offset_components)) == (2, 2)
    twice = ExpressionRegression.fit(neutrals[:3].repeat(2, 1, 1), expressions[:3].repeat(2, 1, 1, 1))
    torch.testing.assert_close(twice(neutrals[:2]), few(neutrals[:2]), rtol=0, atol=1e-3)
    alike = ExpressionRegression.fit(neutrals, neutrals[:, None] + noise(1, 2, V, 3).double())
    assert len(alike.offset_components) <= 13
    still = ExpressionRegression.fit(neutrals, neutrals[:, None])
    assert torch.equal(still(neutrals), neutrals[:, None])


def test_where_neutrals_do_not_differ_everybody_gets_the_mean() -> None:
    """Heads differ in how far apart two vertices are, which turns none; the second expression moves others."""
    base, apart = 50 * noise(V, 3), noise(12, seed=1)
    base[:2] = torch.tensor([[50.0, 0, 0], [-50, 0, 0]])
    heads = base.expand(12, -1, -1).clone()
    heads[:, :2, 0] += torch.stack([apart, -apart], 1)
    offsets = torch.zeros(12, 2, V, 3)
    offsets[:, 0, :2, 1], offsets[:, 1, V // 2 :] = 9 + 2 * apart[:, None], 4 + noise(12, V // 2, 3)
    model = ExpressionRegression.fit(heads, heads[:, None] + offsets)
    found = model.offsets(heads)
    torch.testing.assert_close(found[:, 0], offsets[:, 0], rtol=0, atol=1e-3)
    torch.testing.assert_close(found[:, 1], offsets[:, 1].mean(0).expand(12, -1, -1), rtol=0, atol=1e-3)
    assert model.distance(heads).square().mean() < 1


def test_models_of_older_versions_load(people: tuple[Tensor, Tensor]) -> None:
    """They had one set of components for all expressions: of expressions that move the same vertices it is as good."""
    neutrals, expressions = people
    new = ExpressionRegression.fit(neutrals, expressions, ExpressionSettings(4, 8), region=torch.ones(V) > 0)
    region, moving = (sum(sizes) for sizes in new.sizes)
    state = new.state_dict()
    state["region"], state["neutral_components"] = state["region"][:V], state["neutral_components"][:, :V]
    places = moving // 2
    J = len(new.offset_components)
    outer = torch.zeros(2 * J, moving, 3)
    outer[:J, :places], outer[J:, places:] = new.offset_components[:, :places], new.offset_components[:, places:]
    state["offset_components"], state["coefficients"] = outer, torch.cat(list(new.coefficients), 1)
    state["deviations"] = state["deviations"][0]
    old = ExpressionRegression.from_config(
        new.config | {"region": region // 2, "moving": moving, "offset_components": 2 * J}
    )
    old.load_state_dict(state)
    torch.testing.assert_close(old(neutrals), new(neutrals), rtol=0, atol=1e-3)
    torch.testing.assert_close(old.distance(neutrals), new.distance(neutrals))
    assert (old.config["region"], old.config["moving"]) == (V, moving)
    torch.testing.assert_close(
        OffsetRegression(old)(neutrals.float()), new.offsets(neutrals).float(), rtol=0, atol=1e-2
    )


def test_bad_input_is_named(people: tuple[Tensor, Tensor]) -> None:
    neutrals, expressions = people
    fit = ExpressionRegression.fit
    with pytest.raises(ShapeError, match=r"found \(1,40,3\)|at least two people"):
        fit(neutrals[:1], expressions[:1])
    with pytest.raises(ShapeError, match=r"expected \(24,N,40,3\)"):
        fit(neutrals, expressions[:, :, 1:])
    with pytest.raises(ShapeError, match="three at least"):
        fit(neutrals[:2], expressions[:2], ExpressionSettings(neutral_components=None))
    with pytest.raises(ValueRangeError, match="expressions: number 3 holds NaN"):
        fit(neutrals, torch.where(torch.arange(24).view(24, 1, 1, 1) == 3, torch.nan, expressions))
    with pytest.raises(ValueRangeError, match="all the same"):
        fit(neutrals[:1].expand(5, -1, -1), expressions[:5])
    with pytest.raises(NameMismatchError, match="found 1, expected one for each of 2"):
        fit(neutrals, expressions, names=["smile"])
    with pytest.raises(NameMismatchError, match="distinct"):
        fit(neutrals, expressions, names=["smile", "smile"])
    with pytest.raises(ValueRangeError, match="ridge: found -1"):
        fit(neutrals, expressions, ExpressionSettings(ridge=-1.0))
    with pytest.raises(ValueRangeError, match="neutral_components: found 0"):
        fit(neutrals, expressions, ExpressionSettings(neutral_components=0))
    with pytest.raises(ShapeError, match=r"expected \(B,40,3\)"):
        fit(neutrals, expressions)(neutrals[:, 1:])
    with pytest.raises(ShapeError, match=r"expected \(B,40,3\)"):
        fit(neutrals, expressions).distance(neutrals[:, 1:])
    for what, wrong in (("region", [39]), ("moving", 78), ("region", [40, -1])):
        with pytest.raises(ShapeError, match=rf"{what}: found .*, expected a number for each of 2"):
            ExpressionRegression.from_config(fit(neutrals, expressions).config | {what: wrong})
    with pytest.raises(ShapeError, match=r"found \(24, 0, 40, 3\)"):
        fit(neutrals, expressions[:, :0])


def test_people_may_be_arrays_or_parts_of_a_graph(people: tuple[Tensor, Tensor]) -> None:
    wanted = ExpressionRegression.fit(*people)
    for given in ([x.numpy() for x in people], [x.clone().requires_grad_() for x in people]):
        assert torch.equal(ExpressionRegression.fit(*given).coefficients, wanted.coefficients)


@pytest.mark.real
def test_real_heads_get_the_shapes_that_they_have(ict_folder: Path) -> None:
    """ICT's shapes are the same for every identity: whatever head comes, it gets them."""
    from torchface.io.rigs.ict_facekit import load_identity_modes

    rig: BlendshapeRig = load_rig(ict_folder, part="face").select(["mouthSmile_L", "jawOpen"])
    modes = load_identity_modes(ict_folder, 10, part="face").deltas
    heads = rig.vertices + torch.einsum("mk,kvc->mvc", noise(12, 10), modes)
    model = ExpressionRegression.fit(heads[:10], heads[:10, None] + rig.deltas, names=rig.names)
    made = rig_from_neutral(model, rig, rig.neutral.with_vertices(heads[11]))
    moved = rig.deltas.norm(dim=-1).max()
    assert (made.deltas - rig.deltas).norm(dim=-1).max() < 0.05 * moved


def test_shapes_that_the_model_predicts_worse_are_transferred() -> None:
    """Of a person whom the zoo's model has not seen: the choice is better than either way alone."""
    model = zoo.get_model("expressions", ExpressionRegression)
    person = performer(draw_identities(3, torch.Generator().manual_seed(77))[1], texture=False).select(model.names)
    template = performer(texture=False).select(model.names)
    made = neutral_rig(model, template, person.neutral)
    squared = (made.rig.deltas - person.deltas).square().sum((1, 2))
    assert bool(made.learned.all())
    assert bool((squared < 0.2 * (made.transferred.deltas - person.deltas).square().sum((1, 2))).all())
    found = (squared / len(person.vertices)).sqrt()
    assert (found / made.expected[0]).log().abs().max() < math.log(4)
    # A model that has learned the contrary of blinks, and knows it.
    model.coefficients[-2:] *= -1
    model.errors[0, -2:] = 100.0
    made = neutral_rig(model, template, person.neutral)
    errors = {
        "rig": made.rig.deltas,
        "transfer": made.transferred.deltas,
        "regression": model.offsets(person.vertices[None])[0],
    }
    squared = {name: (deltas - person.deltas).square().sum((1, 2)) for name, deltas in errors.items()}
    assert [name for name, row in zip(made.rig.names, made.learned, strict=True) if not row] == [
        "eyeBlinkLeft",
        "eyeBlinkRight",
    ]
    assert squared["rig"].sum() < min(squared["regression"].sum(), squared["transfer"].sum())


def test_distance_is_that_of_the_people_learned_from(people: tuple[Tensor, Tensor]) -> None:
    """Mean square 1 along components among those learned from, whatever their pose; it grows with how far one goes."""
    neutrals, expressions = people
    model = ExpressionRegression.fit(neutrals, expressions, ExpressionSettings(neutral_components=3))
    squared = model.distance(neutrals).square()
    assert abs(float(squared.mean()) - 2 * 23 / 24) < 0.15
    moved = turned(neutrals[0])[0]
    torch.testing.assert_close(model.distance(moved[None]), model.distance(neutrals[:1]), rtol=1e-3, atol=1e-3)
    aligned = neutrals.mean(0) + 10 * (neutrals[:1] - neutrals.mean(0))
    assert model.distance(aligned)[0] > 5 * model.distance(neutrals[:1])[0]
    unjudged = ExpressionRegression.from_config(model.config | {"judged": False})
    assert bool(unjudged.distance(neutrals).isnan().all())

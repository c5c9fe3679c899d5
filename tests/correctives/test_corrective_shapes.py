"""Correctives: products of weights and in-betweens, against plain loops."""

import pytest
import torch
from torch import Tensor

from torchface import BlendshapeRig, Corrective, Correctives, Mesh, TorchfaceError
from torchface.correctives.activation import CorrectiveActivation
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError

SHAPES = ("a", "b", "c", "d")
DEFINITIONS = (
    Corrective("ab", ("a", "b")),
    Corrective("bcd", ("d", "b", "c")),
    Corrective("a25", ("a",), 0.25),
    Corrective("a75", ("a",), 0.75),
    Corrective("c40", ("c",), 0.4),
    Corrective("all", ("c", "a", "d", "b")),
)


def corrective_rig(seed: int = 0, names: tuple[str, ...] = SHAPES) -> BlendshapeRig:
    generator = torch.Generator().manual_seed(seed)
    neutral = Mesh(torch.randn(6, 3, generator=generator), torch.tensor([[0, 1, 2], [2, 3, 4], [3, 4, 5]]))
    deltas = torch.randn(len(names), 6, 3, generator=generator)
    return BlendshapeRig(
        neutral, deltas, names, Correctives(torch.randn(len(DEFINITIONS), 6, 3, generator=generator), DEFINITIONS)
    )


def one_frame(rig: BlendshapeRig, weights: Tensor) -> Tensor:
    """A frame by the words of the docstring."""
    w = dict(zip(rig.names, weights.tolist(), strict=True))
    vertices = rig.vertices.double().clone()
    for name, delta in zip(rig.names, rig.deltas, strict=True):
        vertices += w[name] * delta
    for definition, delta in zip(rig.correctives.definitions, rig.correctives.deltas, strict=True):
        if definition.peak is None:
            on = 1.0
            for driver in definition.drivers:
                on *= w[driver]
        else:
            own = [
                d.peak for d in rig.correctives.definitions if d.drivers == definition.drivers and d.peak is not None
            ]
            low = max([p for p in own if p < definition.peak], default=0.0)
            high = min([p for p in own if p > definition.peak], default=1.0)
            at = w[definition.drivers[0]]
            on = max(0.0, min((at - low) / (definition.peak - low), (high - at) / (high - definition.peak)))
        vertices += on * delta
    return vertices


def test_a_batch_is_what_a_loop_over_correctives_gives() -> None:
    rig = corrective_rig()
    weights = torch.rand(7, 4, generator=torch.Generator().manual_seed(1))
    weights[0], weights[1] = 0.0, 1.0
    found = rig(weights)
    torch.testing.assert_close(found, torch.stack([one_frame(rig, row) for row in weights]).float())
    assert torch.equal(found[0], rig.vertices)


def test_in_betweens_join_samples_by_straight_lines() -> None:
    rig = corrective_rig()
    a25, a75 = rig.correctives.deltas[2], rig.correctives.deltas[3]
    samples = [0 * a25, 0.25 * rig.deltas[0] + a25, 0.75 * rig.deltas[0] + a75, rig.deltas[0]]
    weights = torch.zeros(5, 4)
    weights[:, 0] = torch.tensor([0.125, 0.25, 0.5, 0.75, 0.875])
    expected = [
        *(0.5 * (samples[0] + samples[1]), samples[1], 0.5 * (samples[1] + samples[2]), samples[2]),
        0.5 * (samples[2] + samples[3]),
    ]
    torch.testing.assert_close(rig(weights) - rig.vertices, torch.stack(expected))


def test_derivatives_agree_with_finite_differences() -> None:
    activation = CorrectiveActivation(DEFINITIONS, SHAPES)
    weights = torch.rand(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2)).requires_grad_()
    assert torch.autograd.gradcheck(activation, weights)
    jacobian = torch.autograd.functional.jacobian(lambda w: activation(w).sum(0), weights).permute(1, 0, 2)
    sparse = torch.zeros(3, len(DEFINITIONS), 5, dtype=torch.float64)
    own = activation.derivative(weights.detach())
    sparse.scatter_add_(2, activation.drivers.expand_as(own), own)
    torch.testing.assert_close(sparse[..., :4], jacobian)


def test_correctives_follow_their_rig() -> None:
    rig = corrective_rig()
    weights = torch.rand(3, 4, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(rig.part(torch.tensor([2, 3, 4, 5]))(weights), rig(weights)[:, 2:])
    some = rig.select(["c", "a", "b"])
    assert some.correctives.names == ("ab", "a25", "a75", "c40")
    weights[:, 3] = 0.0
    torch.testing.assert_close(some(weights[:, [2, 0, 1]]), rig(weights))
    assert rig.select(["d"]).correctives is None
    precise = rig.double()
    assert precise.correctives.deltas.dtype == torch.float64
    assert set(precise.state_dict()) == {"vertices", "deltas", "corrective_deltas"}


def test_merged_halves_keep_what_their_correctives_showed() -> None:
    names = ("browInnerUp_L", "browInnerUp_R", "jawOpen")
    generator = torch.Generator().manual_seed(4)
    neutral = Mesh(torch.randn(3, 3, generator=generator), torch.tensor([[0, 1, 2]]))
    definitions = (
        Corrective("left_jaw", ("browInnerUp_L", "jawOpen")),
        Corrective("right_jaw", ("jawOpen", "browInnerUp_R")),
        Corrective("left_half", ("browInnerUp_L",), 0.5),
        Corrective("right_third", ("browInnerUp_R",), 0.3),
    )
    correctives = Correctives(torch.randn(4, 3, 3, generator=generator), definitions)
    rig = BlendshapeRig(neutral, torch.randn(3, 3, 3, generator=generator), names, correctives)
    merged = rig.with_arkit_names()
    assert merged.correctives.names == ("left_jaw", "right_third", "left_half")
    weights = torch.rand(9, 2, generator=generator)
    whole = dict(zip(merged.names, range(2), strict=True))
    brow, jaw = weights[:, whole["browInnerUp"]], weights[:, whole["jawOpen"]]
    torch.testing.assert_close(merged(weights), rig(torch.stack([brow, brow, jaw], 1)))
    square = Correctives(correctives.deltas[:1], (Corrective("both", ("browInnerUp_L", "browInnerUp_R")),))
    with pytest.raises(NameMismatchError, match=r"'both'.*become one shape, 'browInnerUp'"):
        BlendshapeRig(neutral, rig.deltas, names, square).with_arkit_names()


@pytest.mark.parametrize(
    ("definitions", "message"),
    [
        ([("x", ("a", "missing"), None)], "'x': driven by 'missing', which the rig lacks"),
        ([("x", ("a", "y"), None), ("y", ("b", "z"), None), ("z", ("c", "x"), None)], "a cycle, x -> y -> z -> x"),
        ([("x", ("a", "x"), None)], "a cycle, x -> x"),
        ([("x", ("a", "y"), None), ("y", ("b", "c"), None)], "'x' is driven by the corrective 'y'"),
        ([("x", tuple("abcdefghi"), None)], "a product of 9 shapes, expected two to 8"),
        ([("x", (), None)], "a product of 0 shapes"),
        ([("x", ("a", "a"), None)], "a driver twice in a, a"),
        ([("x", "ab", None)], "drivers 'ab', expected a list"),
        ([("x", ("a", "b"), None), ("x", ("a", "c"), None)], "more than once: x"),
        ([("x", ("a", "b"), None), ("y", ("b", "a"), None)], "'x' and 'y' driven by the same b x a"),
        ([("x", ("a",), 0.5), ("y", ("a",), 0.5)], "driven by the same a at 0.5"),
        ([("a", ("b", "c"), None)], "a shape of that name"),
        ([("x", ("a",), None)], "peak: found None"),
        ([("x", ("a",), 0.0)], "peak: found 0, expected"),
        ([("x", ("a",), 1.0)], "peak: found 1, expected less"),
        ([("x", ("a",), float("nan"))], "peak: found nan"),
        ([("x", ("a", "b"), 0.5)], "found peak 0.5 for 2 drivers"),
        ([("", ("a", "b"), None)], "expected a name"),
    ],
)
def test_bad_definitions_are_named(definitions: list[tuple[str, tuple[str, ...], float | None]], message: str) -> None:
    rig = corrective_rig()

    def build() -> None:
        made = tuple(Corrective(*row) for row in definitions)
        BlendshapeRig(rig.neutral, rig.deltas, rig.names, Correctives(torch.zeros(len(made), 6, 3), made))

    with pytest.raises(TorchfaceError, match=message):
        build()


def test_bad_deltas_are_named() -> None:
    rig = corrective_rig()
    with pytest.raises(ShapeError, match=r"found deltas \(4, 6, 3\) for 6 definitions"):
        Correctives(torch.zeros(4, 6, 3), DEFINITIONS)
    with pytest.raises(ShapeError, match="found none"):
        Correctives(torch.zeros(0, 6, 3), ())
    with pytest.raises(ShapeError, match=r"found deltas \(6, 7, 3\), expected \(C,6,3\)"):
        BlendshapeRig(rig.neutral, rig.deltas, rig.names, Correctives(torch.zeros(6, 7, 3), DEFINITIONS))
    broken = torch.zeros(6, 6, 3)
    broken[1, 2, 0] = torch.nan
    with pytest.raises(ValueRangeError, match="NaN or infinite in bcd"):
        Correctives(broken, DEFINITIONS)

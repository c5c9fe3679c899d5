"""The projected gradient layer finds the optimum, also under transforms, compiled and in ONNX; its derivatives."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, TorchfaceError, ValueRangeError
from torchface.optim import FixedSplitting, ProjectedGradient, box_qp
from torchface.optim.projected_gradient import largest_eigenvalue


def hessians(*shape: int, size: int = 8, seed: int = 0) -> Tensor:
    """Scales of variables as far apart as weights and millimetres are."""
    A = torch.randn(*shape, 3 * size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    A = A * torch.logspace(-1, 1, size, dtype=torch.float64)
    return A.mT @ A


def slopes(*shape: int, H: Tensor, seed: int = 1) -> Tensor:
    """Of problems with solutions inside the box and at both of its bounds."""
    aim = torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 3 - 1
    return -(aim[..., None, :] @ H)[..., 0, :]


@pytest.mark.parametrize("own", [False, True], ids=["shared", "each"])
@pytest.mark.parametrize(("lower", "upper"), [(0.0, 1.0), (-torch.inf, 0.5), (-torch.inf, torch.inf)])
def test_the_optimum_of_the_exact_solver(own: bool, lower: float, upper: float) -> None:
    H = hessians(*((20,) if own else ()))
    f = slopes(20, 8, H=H)
    layer = ProjectedGradient(H, lower, upper, steps=600)
    wanted = box_qp(H, f, lower, upper)
    torch.testing.assert_close(layer(f), wanted, rtol=0, atol=1e-9)
    other = ProjectedGradient(None, lower, upper, steps=600)
    torch.testing.assert_close(other(f, H), wanted, rtol=0, atol=1e-9)
    found = layer(f)
    assert torch.equal(found == upper, wanted == upper)
    assert torch.equal(found == lower, wanted == lower)
    single = ProjectedGradient(H.float(), lower, upper)(f.float())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), wanted, rtol=0, atol=1e-4)


def test_restarts_make_the_difference_where_h_is_badly_conditioned() -> None:
    """Plain steps in the same metric are as far off after ten times as many."""
    H = hessians(size=12) + 50 * torch.ones(12, 12, dtype=torch.float64)
    f = slopes(30, 12, H=H)
    wanted = box_qp(H, f)
    found = ProjectedGradient(H, steps=200)(f)
    x, rate = torch.zeros_like(f), 1 / (largest_eigenvalue(H) * H.diagonal())
    for _ in range(2000):
        x = (x - rate * (x @ H + f)).clamp(0, 1)
    assert (found - wanted).abs().max() < 0.1 * (x - wanted).abs().max()


def test_it_stops_where_the_residual_is_reached_and_not_before() -> None:
    H = hessians()
    f = slopes(50, 8, H=H)
    coarse = ProjectedGradient(H, steps=10_000, tolerance=1e-3)(f)
    left = (coarse - (coarse - (coarse @ H + f) / H.diagonal()).clamp(0, 1)).abs().max()
    assert 1e-7 < left <= 1e-3
    wanted = box_qp(H, f)
    kept = ProjectedGradient(H, steps=1, tolerance=1e-6)(f, start=wanted)
    torch.testing.assert_close(kept, wanted, rtol=0, atol=1e-9)
    assert ProjectedGradient(H, tolerance=1e-3)(f[:0]).shape == (0, H.shape[-1])


@pytest.mark.parametrize("shape", [(), (5,)])
def test_the_largest_eigenvalue(shape: tuple[int, ...]) -> None:
    H = hessians(*shape, size=20)
    scale = H.diagonal(dim1=-2, dim2=-1).rsqrt()
    wanted = torch.linalg.eigvalsh(H * scale[..., :, None] * scale[..., None, :])[..., -1]
    found = largest_eigenvalue(H)
    assert (found <= wanted * (1 + 1e-12)).all()
    assert (found >= 0.95 * wanted).all()


@pytest.mark.parametrize("own", [False, True], ids=["shared", "each"])
@pytest.mark.parametrize("through_steps", [False, True], ids=["implicit", "through the steps"])
def test_derivatives_are_those_of_finite_differences(own: bool, through_steps: bool) -> None:
    H = hessians(*((2,) if own else ()), size=3)
    f = slopes(2, 3, H=H, seed=2)
    layer = ProjectedGradient(steps=40 if through_steps else 120, through_steps=through_steps)

    def solved(H: Tensor, f: Tensor) -> Tensor:
        found: Tensor = layer(f, 0.5 * (H + H.mT))
        return found

    at_bound = (solved(H, f) <= 0) | (solved(H, f) >= 1)
    assert at_bound.any()
    assert not at_bound.all()
    given = H.requires_grad_(), f.requires_grad_()
    assert torch.autograd.gradcheck(solved, given, eps=1e-6, atol=1e-6)
    if not through_steps:
        assert torch.autograd.gradgradcheck(solved, given, eps=1e-6, atol=1e-5)


def test_transforms_are_loops() -> None:
    H = hessians(4, size=5)
    f = slopes(4, 5, H=H)
    layer = ProjectedGradient()
    looped = torch.stack([layer(f[i : i + 1], H[i]) for i in range(4)])
    torch.testing.assert_close(torch.func.vmap(layer)(f[:, None], H), looped, rtol=0, atol=1e-10)
    wanted = torch.autograd.functional.jacobian(lambda f: layer(f, H), f)
    for jacobian in (torch.func.jacrev, torch.func.jacfwd):
        torch.testing.assert_close(jacobian(lambda f: layer(f, H))(f), wanted, rtol=0, atol=1e-9)


@pytest.mark.bench  # tests/modules compiles the layer
def test_a_compiled_network_learns_as_it_does_uncompiled() -> None:
    """In one graph, its backward pass too."""
    layer = ProjectedGradient(nn.Parameter(hessians(size=5)))
    f = slopes(6, 5, H=hessians(size=5))

    def loss(f: Tensor) -> Tensor:
        found: Tensor = layer(f)
        return (found * torch.arange(5.0)).square().sum()

    wanted = torch.autograd.grad(loss(f), layer.H)[0]
    torch.compiler.reset()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(torch.autograd.grad(compiled(f), layer.H)[0], wanted, rtol=1e-8, atol=1e-10)


class WithHessian(nn.Module):
    """The layer with an H of each frame, made in the graph."""

    def __init__(self, layer: ProjectedGradient) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, f: Tensor, rows: Tensor) -> Tensor:
        found: Tensor = self.layer(f, rows.mT @ rows)
        return found


@pytest.mark.bench  # tests/onnx/test_module_graph.py exports a network with the layer in it
@pytest.mark.parametrize("own", [False, True], ids=["shared", "each"])
def test_onnx_runtime_computes_the_same_in_a_loop(tmp_path: Path, own: bool) -> None:
    """An H that the graph holds, and one that it computes of its inputs, with a tolerance."""
    H = hessians(*((6,) if own else ())).float()
    given = {"f": slopes(6, 8, H=H.double()).float()}
    module: nn.Module = ProjectedGradient(H)
    if own:
        module = WithHessian(ProjectedGradient(tolerance=1e-5))
        given["rows"] = torch.linalg.cholesky(H.double()).mT.float()
    path, frames = tmp_path / "program.onnx", torch.export.Dim("frames")
    shapes: Any = tuple({0: frames} for _ in given)
    names = list(given)
    torch.onnx.export(
        module.eval(), tuple(given.values()), path, input_names=names, dynamic_shapes=shapes, verbose=False
    )
    assert [node.op_type for node in onnx.load(path).graph.node].count("Loop") == 1 + own  # the eigenvalue's
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for count in (1, 5):
        some = [value[:count] for value in given.values()]
        (found,) = session.run(None, {name: value.numpy() for name, value in zip(names, some, strict=True)})
        np.testing.assert_allclose(found, module(*some).numpy(), atol=3e-6)


@pytest.mark.bench  # as the one above
def test_a_network_that_learns_is_written_as_it_is(tmp_path: Path) -> None:
    network = nn.Sequential(nn.Linear(3, 5), ProjectedGradient(hessians(size=5).float(), steps=50)).eval()
    features = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    torch.onnx.export(network, (features,), tmp_path / "network.onnx", dynamo=True, verbose=False)
    session = onnxruntime.InferenceSession(tmp_path / "network.onnx", providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {session.get_inputs()[0].name: features.numpy()})
    np.testing.assert_allclose(found, network(features).detach().numpy(), atol=3e-6)


@pytest.mark.parametrize("layer", [ProjectedGradient, FixedSplitting])
def test_bounds_keep_their_precision(layer: Any) -> None:
    H = hessians(size=3)
    low = torch.tensor([0.1, -torch.inf, 0.3], dtype=torch.float64)
    f = 9 * slopes(6, 3, H=H).abs()
    found = layer(H, low, 0.7, 300).double()(f)
    assert (found[:, 2] == low[2]).any()
    for one in (found, layer(None, low, 0.7, 300).double()(f, H)):
        assert ((one >= low) & (one <= 0.7)).all()
        torch.testing.assert_close(one, box_qp(H, f, low, 0.7), rtol=0, atol=1e-5)


def test_the_eigenvalue_follows_h() -> None:
    layer = ProjectedGradient(hessians(size=5))
    assert set(layer.state_dict()) == {"H", "eigenvalue", "lower", "upper"}
    layer.H += 1e3 * torch.ones(5, 5)
    f = slopes(6, 5, H=layer.H)
    torch.testing.assert_close(layer(f), box_qp(layer.H, f), rtol=0, atol=1e-8)
    assert layer.eigenvalue == largest_eigenvalue(layer.H)


@pytest.mark.parametrize(
    ("made", "called", "error", "says"),
    [
        ({"H": torch.diag(torch.tensor([1.0, 0.0]))}, None, ValueRangeError, r"rows \[1\] of H that are zero"),
        ({}, {"H": torch.diag(torch.tensor([0.0, 1.0]))}, ValueRangeError, r"rows \[0\] of H that are zero"),
        ({"H": torch.tensor([[1.0, 2.0], [2.0, 1.0]])}, None, ValueRangeError, "not positive semidefinite"),
        ({"H": torch.eye(2), "lower": torch.zeros(3)}, None, ShapeError, "ProjectedGradient: found lower"),
        ({"lower": 2.0}, None, ValueRangeError, "lower 2.0 above upper 1.0"),
        ({"upper": torch.ones(3)}, {"H": torch.eye(2)}, ShapeError, "expected 3 columns"),
        ({"steps": -1}, None, ValueRangeError, "steps: found -1"),
        ({"tolerance": -1.0}, None, ValueRangeError, "tolerance: found -1"),
        ({}, {}, ShapeError, "found no H"),
        ({}, {"H": torch.eye(3)}, ShapeError, "ProjectedGradient: found f"),
        ({}, {"H": torch.eye(2).double()}, ValueRangeError, "expected the same"),
        ({}, {"H": torch.full((2, 2), torch.nan)}, ValueRangeError, "H holds NaN"),
        ({}, {"H": torch.eye(2), "start": torch.zeros(3, 2)}, ShapeError, "found start"),
        ({}, {"H": torch.diag(torch.tensor([2e-7, 2e9]))}, ValueRangeError, r"nearly so beside the .* 2e\+09"),
    ],
)
def test_bad_input_ends_in_what_was_found_and_expected(
    made: dict[str, Any], called: dict[str, Any] | None, error: type[TorchfaceError], says: str
) -> None:
    with pytest.raises(error, match=says):
        ProjectedGradient(**made)(torch.zeros(2, 2), **(called or {}))


@pytest.mark.parametrize(
    ("made", "called", "error", "says"),
    [
        ({"H": torch.tensor([[1.0, 2.0], [2.0, 1.0]])}, {}, ValueRangeError, "not positive semidefinite"),
        ({"lower": 1.0, "upper": 0.0}, {}, ValueRangeError, "lower 1.0 above upper 0.0"),
        ({"lower": torch.zeros(2), "upper": torch.ones(3)}, {}, ShapeError, r"upper \(3,\), expected .* \(2,\)"),
        ({}, {}, ShapeError, "found no H"),
        ({"H": torch.eye(3)}, {}, ShapeError, r"f \(2, 2\), expected \(B,3\)"),
        ({"H": torch.eye(2)}, {"f": torch.full((2, 2), torch.nan)}, ValueRangeError, r"rows \[0, 1\]"),
        ({}, {"H": torch.full((2, 2), torch.nan)}, ValueRangeError, "H holds NaN"),
    ],
)
def test_splitting_checks_the_same(
    made: dict[str, Any], called: dict[str, Any], error: type[TorchfaceError], says: str
) -> None:
    with pytest.raises(error, match=f"FixedSplitting: .*{says}"):
        FixedSplitting(**made)(**{"f": torch.zeros(2, 2), **called})

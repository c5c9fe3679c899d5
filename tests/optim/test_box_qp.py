"""box_qp finds the minimum: planted solutions, scipy, optimality conditions, derivatives, bad input."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.optim import BoxQP, ProjectedGradient, box_qp
from torchface.optim.prepared_program import PreparedProgram

INF = math.inf


@pytest.fixture(params=["one by one", "as a batch"], autouse=True)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the two solvers that ``box_qp`` chooses between, whatever the numbers of problems and variables."""
    monkeypatch.setattr(PreparedProgram, "_few", 1e9 if request.param == "one by one" else -1)


def hessian(variables: int, least: float, largest: float, seed: int = 0, rank: int | None = None) -> Tensor:
    """A dense H with eigenvalues spread evenly in the logarithm, those beyond ``rank`` zero."""
    generator = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(torch.randn(variables, variables, generator=generator, dtype=torch.float64))[0]
    values = torch.logspace(math.log10(largest), math.log10(least), variables, dtype=torch.float64)
    values[rank if rank is not None else variables :] = 0
    H = basis * values @ basis.T
    return 0.5 * (H + H.T)


def planted(H: Tensor, problems: int, lower: float = 0.0, upper: float = 1.0, seed: int = 1) -> tuple[Tensor, Tensor]:
    """f (B,N) and the unique solutions that it was made for: g = Hx + f is 0 inside, of the right sign at bounds."""
    generator = torch.Generator().manual_seed(seed)
    shape = (problems, H.shape[-1])
    u = torch.rand(shape, generator=generator, dtype=torch.float64) * 2 - 0.5
    low, high = max(lower, -2.0), min(upper, 2.0)
    x = (low + (high - low) * u).clamp(lower, upper).clamp(-3, 3)
    push = H.diagonal(dim1=-2, dim2=-1) * torch.rand(shape, generator=generator, dtype=torch.float64)
    gradient = torch.where(x <= lower, push, torch.where(x >= upper, -push, 0.0))
    bent = x @ H if H.ndim == 2 else torch.bmm(H, x[..., None])[..., 0]
    return gradient - bent, x


def residual(H: Tensor, f: Tensor, x: Tensor, lower: float = 0.0, upper: float = 1.0) -> float:
    bent = x @ H if H.ndim == 2 else torch.bmm(H, x[..., None])[..., 0]
    step = x - (bent + f) / H.diagonal(dim1=-2, dim2=-1)
    return float((x - step.clamp(lower, upper)).abs().max())


@pytest.mark.parametrize(("variables", "problems"), [(1, 1), (2, 1000), (16, 300), (53, 300), (140, 40), (280, 10)])
def test_a_planted_solution_is_found(variables: int, problems: int) -> None:
    H = hessian(variables, 0.07, 18000.0)
    f, x = planted(H, problems)
    found = box_qp(H, f)
    assert residual(H, f, found) <= 1e-8
    torch.testing.assert_close(found, x, rtol=0, atol=1e-5)
    coarse = box_qp(H.float(), f.float())
    assert coarse.dtype == torch.float32
    assert residual(H.float().double(), f.float().double(), coarse.double()) <= 1e-4


@pytest.mark.parametrize(("lower", "upper"), [(0.0, INF), (-INF, 0.5), (-INF, INF), (-2.0, 3.0)])
def test_bounds_may_be_infinite(lower: float, upper: float) -> None:
    H = hessian(20, 0.1, 1000.0)
    f, x = planted(H, 100, lower, upper)
    torch.testing.assert_close(box_qp(H, f, lower, upper), x, rtol=0, atol=1e-7)


def test_without_bounds_it_is_a_linear_solve() -> None:
    H = hessian(30, 0.1, 1000.0)
    f = torch.randn(50, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(box_qp(H, f, -INF, INF), -torch.linalg.solve(H, f.T).T, rtol=0, atol=1e-7)


def test_bounds_of_each_variable_hold_and_equal_bounds_fix_it() -> None:
    H = hessian(12, 0.1, 100.0)
    lower, upper = torch.linspace(-1, 0.5, 12), torch.linspace(0.5, 0.5, 12)
    f = 100 * torch.randn(40, 12, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    x = box_qp(H, f, lower, upper)
    assert (x >= lower).all()
    assert (x <= upper).all()
    assert (x[:, -1] == 0.5).all()
    step = x - (x @ H + f) / H.diagonal()
    assert (x - torch.minimum(torch.maximum(step, lower), upper)).abs().max() <= 1e-8


def test_an_h_for_each_problem_gives_what_one_by_one_gives() -> None:
    H = torch.stack([hessian(15, 0.05, 500.0, seed=seed) for seed in range(60)])
    f, x = planted(H, 60)
    together = box_qp(H, f)
    torch.testing.assert_close(together, x, rtol=0, atol=1e-7)
    alone = torch.cat([box_qp(H[i], f[i : i + 1]) for i in range(60)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-8)


def test_scipy_agrees() -> None:
    generator = torch.Generator().manual_seed(5)
    A = torch.randn(40, 10, generator=generator, dtype=torch.float64)
    targets = torch.randn(20, 40, generator=generator, dtype=torch.float64)
    found = box_qp(A.T @ A, -targets @ A)
    for target, x in zip(targets, found, strict=True):
        reference = lsq_linear(A.numpy(), target.numpy(), (0, 1), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(x.numpy(), reference, atol=1e-9)


@pytest.mark.parametrize("rank", [1, 5, 20])
def test_a_singular_h_still_reaches_the_least_energy(rank: int) -> None:
    H = hessian(30, 0.1, 100.0, rank=rank)
    generator = torch.Generator().manual_seed(7)
    inside = torch.rand(100, 30, generator=generator, dtype=torch.float64)
    f = -inside @ H  # the least of every problem is -½ x'Hx, at x and all along the null space
    x = box_qp(H, f)
    least = -0.5 * ((inside @ H) * inside).sum(-1)
    energy = (x * (0.5 * (x @ H) + f)).sum(-1)
    assert ((energy - least) / least.abs()).max() <= 1e-8


@pytest.mark.parametrize("problems", [1, 300])
def test_a_shape_that_nothing_sees_goes_where_its_price_sends_it(problems: int) -> None:
    H = torch.zeros(3, 3, dtype=torch.float64)
    H[0, 0] = 2.0
    f = torch.tensor([[-1.0, 0.3, -0.3]], dtype=torch.float64).expand(problems, 3)
    x = box_qp(H, f)
    assert torch.equal(x[:, 1:], torch.tensor([0.0, 1.0]).double().expand(problems, 2))
    assert (x[:, 0] - 0.5).abs().max() <= 1e-9
    with pytest.raises(ValueRangeError, match=r"rows \[1, 2\] of H that are zero"):
        ProjectedGradient(H)


def test_a_start_does_not_change_the_answer() -> None:
    H = hessian(20, 0.07, 1000.0)
    f, x = planted(H, 100)
    start = torch.rand(100, 20, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    torch.testing.assert_close(box_qp(H, f, start=start), x, rtol=0, atol=1e-7)
    torch.testing.assert_close(box_qp(H, f, start=x), x, rtol=0, atol=1e-7)


def test_a_prepared_h_gives_the_same_in_any_batch() -> None:
    H = hessian(20, 0.07, 1000.0)
    f, _ = planted(H, 20000)
    qp = BoxQP(H)
    whole = qp(f)
    assert residual(H, f, whole) <= 1e-8
    torch.testing.assert_close(qp(f[777:780]), whole[777:780], rtol=0, atol=1e-9)
    assert qp(f[:0]).shape == (0, 20)


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize(("lower", "upper"), [(0.0, 1.0), pytest.param(0.0, INF, marks=pytest.mark.bench)])
def test_derivatives_with_bounds_active(each: bool, lower: float, upper: float) -> None:
    H = hessian(6, 0.5, 20.0)
    if each:
        H = torch.stack([hessian(6, 0.5, 20.0, seed=seed) for seed in range(4)])
    f, x = planted(H, 4, lower, upper)
    at_bound = (x <= lower) | (x >= upper)
    assert at_bound.any()
    assert not at_bound.all()

    def solve(H: Tensor, f: Tensor) -> Tensor:
        return box_qp(0.5 * (H + H.transpose(-1, -2)), f, lower, upper)

    assert torch.autograd.gradcheck(solve, (H.requires_grad_(), f.requires_grad_()), eps=1e-6, atol=1e-6)


def test_the_gradient_of_h_is_symmetric() -> None:
    H = hessian(6, 0.5, 20.0).requires_grad_()
    f, _ = planted(H.detach(), 4)
    box_qp(H, f).square().sum().backward()
    torch.testing.assert_close(H.grad, H.grad.T)
    assert H.grad.abs().max() > 0


def broken(**changes: object) -> tuple[tuple[Tensor, Tensor], dict[str, object]]:
    given: dict[str, object] = {"H": torch.eye(3), "f": torch.zeros(2, 3), **changes}
    return (given.pop("H"), given.pop("f")), given


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"H": torch.eye(3) + torch.eye(3).roll(1, 0)}, ValueRangeError, "not symmetric"),
        ({"H": torch.full((3, 3), torch.nan)}, ValueRangeError, "H holds NaN"),
        ({"H": torch.diag(torch.tensor([1.0, -1.0, 1.0]))}, ValueRangeError, "not positive semidefinite"),
        ({"H": torch.ones(3, 3) - 0.5 * torch.eye(3)}, ValueRangeError, "eigenvalue -0.5"),
        ({"H": torch.eye(3).expand(5, 3, 3)}, ShapeError, r"expected \(5,3\)"),
        ({"H": torch.ones(3, 2)}, ShapeError, "expected"),
        ({"H": torch.eye(3, dtype=torch.float16)}, ValueRangeError, "float32 or float64"),
        ({"f": torch.zeros(2, 4)}, ShapeError, r"f \(2, 4\)"),
        ({"f": torch.zeros(3)}, ShapeError, "expected"),
        ({"f": torch.zeros(2, 3, dtype=torch.float64)}, ValueRangeError, "expected the same"),
        ({"f": torch.tensor([[0.0, 0.0, 0.0], [0.0, torch.nan, 0.0]])}, ValueRangeError, r"rows \[1\]"),
        ({"lower": 2.0}, ValueRangeError, "lower 2.0 above upper 1.0"),
        ({"lower": torch.zeros(2)}, ShapeError, "found lower"),
        ({"upper": torch.tensor([1.0, torch.nan, 1.0])}, ValueRangeError, "upper holds NaN"),
        ({"lower": INF, "upper": INF}, ValueRangeError, "nothing can meet"),
        ({"start": torch.zeros(1, 3)}, ShapeError, "found start"),
        ({"H": torch.zeros(3, 3), "f": torch.ones(2, 3), "lower": -INF}, ValueRangeError, "no minimum"),
        ({"H": torch.zeros(3, 3), "f": torch.ones(2, 3), "lower": -1e30}, ValueRangeError, r"bounds reach 1e\+30"),
        ({"H": torch.ones(3, 3), "f": torch.eye(3)[:2], "lower": -1e12, "upper": 1e12}, ValueRangeError, "falls"),
        ({"f": torch.full((2, 3), 1e35)}, ValueRangeError, "times the diagonal of H"),
        *(
            ({"tolerance": bad}, ValueRangeError, "tolerance: found")
            for bad in (math.nan, INF, -1e-6, 1e300, 1.0, True, "fine")
        ),
    ],
)
def test_bad_input_says_what_is_wrong(changes: dict[str, object], error: type[Exception], says: str) -> None:
    arguments, rest = broken(**changes)
    with pytest.raises(error, match=says):
        box_qp(*arguments, **rest)


@pytest.mark.parametrize("tolerance", [math.nan, INF, -1.0])
def test_a_module_checks_its_tolerance(tolerance: float) -> None:
    with pytest.raises(ValueRangeError, match="tolerance: found"):
        BoxQP(torch.eye(3), tolerance=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bound", [1e4, 1e12, 1e30, INF])
def test_wide_bounds_agree_with_scipy(bound: float, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(5)
    A = torch.randn(20, 6, generator=generator, dtype=torch.float64)
    targets = 3 * torch.randn(5, 20, generator=generator, dtype=torch.float64)
    lower = torch.tensor([-bound, -bound, 0.0, -0.1, -bound, -1.0], dtype=torch.float64)
    upper = torch.tensor([bound, 0.0, bound, 0.1, bound, 1.0], dtype=torch.float64)
    found = box_qp((A.T @ A).to(dtype), (-targets @ A).to(dtype), lower, upper)
    for target, x in zip(targets, found, strict=True):
        reference = lsq_linear(A.numpy(), target.numpy(), (lower.numpy(), upper.numpy()), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(x.numpy(), reference, atol=1e-9 if dtype == torch.float64 else 3e-5)


@pytest.mark.parametrize("steepness", [1e12, 1e20, 1e29])
def test_a_steep_slope_leads_to_the_bounds(steepness: float) -> None:
    H = hessian(6, 0.5, 20.0)
    f = torch.randn(10, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(box_qp(H, f * steepness), (f < 0).double())


def test_the_module_follows_its_hessian_and_precision() -> None:
    H = hessian(8, 0.5, 20.0)
    f, _ = planted(H, 5)
    qp = BoxQP(torch.nn.Parameter(H.clone()), lower=-1.0)
    qp(f)
    optimizer = torch.optim.SGD(qp.parameters(), lr=0.5)
    with torch.enable_grad():
        qp(f).square().sum().backward()
    optimizer.step()
    assert float((qp.H.detach() - H).abs().max()) > 1e-2
    torch.testing.assert_close(qp(f), box_qp(qp.H.detach(), f, lower=-1.0), rtol=0, atol=1e-9)
    other = BoxQP(hessian(8, 0.5, 20.0, seed=5), lower=-2.0, upper=0.5)
    wanted = other(f)
    qp.load_state_dict(other.state_dict())
    assert set(other.state_dict()) == {"H", "lower", "upper"}
    torch.testing.assert_close(qp(f), wanted, rtol=0, atol=1e-9)
    qp.H.data.mul_(3.0)
    torch.testing.assert_close(qp(f), box_qp(3.0 * other.H, f, -2.0, 0.5), rtol=0, atol=1e-9)
    single = BoxQP(H.float())
    single(f.float())
    torch.testing.assert_close(single.double()(f), box_qp(H.float().double(), f), rtol=0, atol=1e-10)


def test_a_hessian_that_becomes_indefinite_is_refused() -> None:
    qp = BoxQP(torch.eye(3))
    qp.H[0, 0] = -1.0
    with pytest.raises(ValueRangeError, match="not positive semidefinite"):
        qp(torch.zeros(1, 3))


def test_integers_count_as_floats() -> None:
    H, f = torch.tensor([[4, 1], [1, 3]]), torch.tensor([[-1, -2], [3, -9]])
    torch.testing.assert_close(box_qp(H, f), box_qp(H.float(), f.float()))

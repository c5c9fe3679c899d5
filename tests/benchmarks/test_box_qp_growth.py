"""How the solve grows with shapes and frames."""

import math
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch
from quadratic_programming_peers import Solver, daqp_solver, installed, osqp_solver, piqp_solver, quadprog_solver
from torch import Tensor

from torchface import Attachment, BlendshapeRig
from torchface.optim import BoxQP
from torchface.synthetic.stages.marker_stage import place_markers

PEERS: dict[str, Callable[[np.ndarray], Solver]] = {
    "PIQP": piqp_solver,
    "DAQP": daqp_solver,
    "OSQP": osqp_solver,
    "quadprog": quadprog_solver,
}


def blendshape_problem(shapes: int, frames: int) -> tuple[Tensor, Tensor]:
    """Shapes of very different size that overlap, 100 markers, sparse weights, 0.3 mm of noise, sparsity 0.03."""
    generator = torch.Generator().manual_seed(shapes)
    spots = torch.rand(100, 1, 2, generator=generator, dtype=torch.float64)
    centers = torch.rand(1, shapes, 2, generator=generator, dtype=torch.float64)
    reach = 0.15 + 0.2 * torch.rand(1, shapes, generator=generator, dtype=torch.float64)
    near = torch.exp(-(spots - centers).square().sum(-1) / (2 * reach**2))
    size = torch.logspace(-0.5, 1.2, shapes, dtype=torch.float64)
    directions = torch.randn(1, 3, shapes, generator=generator, dtype=torch.float64)
    basis = (near[:, None] * directions * size).flatten(0, 1)
    active = torch.rand(frames, shapes, generator=generator, dtype=torch.float64) < 0.3
    weights = active * torch.rand(frames, shapes, generator=generator, dtype=torch.float64)
    targets = weights @ basis.T + 0.3 * torch.randn(frames, 300, generator=generator, dtype=torch.float64)
    H = 0.02 * basis.T @ basis + 2e-3 * torch.eye(shapes, dtype=torch.float64)
    return H, -0.02 * targets @ basis + 0.03


def widened_problem(capture: tuple[BlendshapeRig, Attachment, list[Tensor]], shapes: int) -> tuple[Tensor, Tensor]:
    """A real rig's 53 shapes and smooth local copies of them, its markers, 0.3 mm of noise, ``MarkerSolver``'s terms.

    Real takes move the rig's own shapes; each copy has the weights of a random shape at another time, times 0.7.
    """
    rig, attachment, takes = capture
    generator = torch.Generator().manual_seed(shapes)
    faces, weights = rig.neutral.faces, torch.cat(takes).double()
    points, basis = attachment.on(faces, rig.vertices).double(), attachment.on(faces, rig.deltas).double()
    extra = shapes - len(basis)
    parent = torch.randint(len(basis), (extra,), generator=generator)
    center = points[torch.multinomial(basis[parent].square().sum(-1).float(), 1, generator=generator)[:, 0]]
    reach = 15 + 15 * torch.rand(extra, generator=generator, dtype=torch.float64)
    near = torch.exp(-(points - center[:, None]).square().sum(-1) / (2 * reach[:, None] ** 2))
    basis = torch.cat((basis, basis[parent] * near[..., None])).flatten(1).T
    shape = torch.randint(weights.shape[1], (extra,), generator=generator).tolist()
    shift = torch.randint(500, len(weights) - 500, (extra,), generator=generator).tolist()
    copies = [0.7 * weights[:, column].roll(by) for column, by in zip(shape, shift, strict=True)]
    weights = torch.cat((weights, *(copy[:, None] for copy in copies)), 1)[:1000]
    noise = torch.randn(len(weights), len(basis), generator=generator, dtype=torch.float64)
    targets = weights @ basis.T + 0.3 * noise
    return 0.02 * basis.T @ basis + 2e-3 * torch.eye(shapes, dtype=torch.float64), -0.02 * targets @ basis + 0.01


def milliseconds(H: Tensor, f: Tensor) -> float:
    """Processor time a frame of all frames at once, the best of three."""
    qp = BoxQP(H.float())
    single, best = f.float(), math.inf
    with torch.inference_mode():
        for _ in range(3):
            begin = time.process_time()
            qp(single)
            best = min(best, time.process_time() - begin)
    return 1000 * best / len(f)


def peer_milliseconds(solve: Solver, f: Tensor) -> float:
    """Processor time a frame of a peer that is called a frame at a time, the best of three passes."""
    rows, best = list(f[: max(4, round(2e5 / f.shape[1] ** 1.7))].numpy()), math.inf
    solve(rows[0])
    for _ in range(3):
        begin = time.process_time()
        for row in rows:
            solve(row)
        best = min(best, time.process_time() - begin)
    return 1000 * best / len(rows)


def worst_residual(H: Tensor, f: Tensor) -> float:
    x = BoxQP(H.float())(f.float()).double()
    bent = x @ H.float().double() + f.float().double()
    return float((x - (x - bent / H.diagonal()).clamp(0, 1)).abs().max())


def growth(problems: dict[int, tuple[Tensor, Tensor]]) -> None:
    """Prints milliseconds a frame by number of shapes, and holds ours against theirs."""
    # The two that are slow from the start take minutes where there are many shapes.
    peers = {name: make for name, make in PEERS.items() if installed(name.lower())}
    ours: list[float] = []
    theirs: dict[str, list[float]] = {name: [] for name in peers}
    heading = "".join(f"{name + ' ms':>12}" for name in peers)
    print(f"{'shapes':>7} {'ours ms':>9} {'residual':>9}{heading}   (all frames at once, float32; peers one by one)")
    for count, (H, f) in problems.items():
        ours.append(milliseconds(H, f))
        left = worst_residual(H, f)
        for name, make in peers.items():
            slow = name in ("OSQP", "quadprog") and count > 300
            theirs[name].append(math.nan if slow else peer_milliseconds(make(H.numpy()), f))
        print(f"{count:7} {ours[-1]:9.4f} {left:9.1e}" + "".join(f"{each[-1]:12.4f}" for each in theirs.values()))
        assert left <= 1e-4
    for count, mine, *others in zip(problems, ours, *theirs.values(), strict=True):
        # Between 53 and 140 shapes the fastest, DAQP, is nearer; the machine's other work moves the ratio by a third.
        least = 4.5 if count > 140 else 2.5 if count == 140 else 0.7
        assert min((other for other in others if not math.isnan(other)), default=math.inf) >= least * mine


@pytest.mark.real
@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("markers", [100, 300])
def test_growth_of_a_real_rig_by_copies(
    markers: int, real_capture: tuple[BlendshapeRig, Attachment, list[Tensor]], print_machine: Callable[..., None]
) -> None:
    rig, _, takes = real_capture
    capture = rig, place_markers(rig, markers), takes
    print_machine("piqp", "daqp", "osqp", "quadprog")
    print(f"{markers} markers")
    growth({count: widened_problem(capture, count) for count in (140, 280, 600)})


@pytest.mark.usefixtures("one_thread")
def test_growth_with_shapes_and_frames(print_machine: Callable[..., None]) -> None:
    shapes = [16, 32, 53, 100, 140, 200, 280, 600]
    print_machine("piqp", "daqp", "osqp", "quadprog")
    growth({count: blendshape_problem(count, 1000) for count in shapes})
    frames = [1, 10, 100, 1000, 10_000, 100_000]
    by_frame = []
    H, f = blendshape_problem(53, frames[-1])
    print(f"{'frames':>7} {'ours ms':>9}   a frame (53 shapes)")
    for count in frames:
        by_frame.append(milliseconds(H, f[:count]))
        print(f"{count:7} {by_frame[-1]:9.4f}")

    # Large batches cost no more a frame than middling ones: memory stays bounded.
    assert by_frame[-1] <= 2 * min(by_frame)

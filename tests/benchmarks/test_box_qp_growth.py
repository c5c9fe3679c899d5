"""How the solve grows with shapes and frames; plots to out/benchmarks/."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib
import pytest
import torch
from quadratic_programming_peers import Solver, daqp_solver, installed, piqp_solver
from torch import Tensor

from torchface.optim import BoxQP

matplotlib.use("Agg")
OUT = Path(__file__).resolve().parents[2] / "out" / "benchmarks"


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
    rows, best = list(f[:100].numpy()), math.inf
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


@pytest.mark.usefixtures("one_thread")
def test_growth_with_shapes_and_frames(print_machine: Callable[..., None]) -> None:
    shapes = [16, 32, 53, 100, 140, 200, 280]
    peers = {name: make for name, make in (("PIQP", piqp_solver), ("DAQP", daqp_solver)) if installed(name.lower())}
    ours, left, theirs = [], [], {name: [] for name in peers}
    print_machine("piqp", "daqp")
    heading = "".join(f"{name + ' ms':>9}" for name in peers)
    print(f"{'shapes':>7} {'ours ms':>9} {'residual':>9}{heading}   (1,000 frames at once, float32; peers one by one)")
    for count in shapes:
        H, f = blendshape_problem(count, 1000)
        ours.append(milliseconds(H, f))
        left.append(worst_residual(H, f))
        for name, make in peers.items():
            theirs[name].append(peer_milliseconds(make(H.numpy()), f))
        print(f"{count:7} {ours[-1]:9.4f} {left[-1]:9.1e}" + "".join(f"{each[-1]:9.4f}" for each in theirs.values()))
    frames = [1, 10, 100, 1000, 10_000, 100_000]
    by_frame = []
    H, f = blendshape_problem(53, frames[-1])
    print(f"{'frames':>7} {'ours ms':>9}   a frame (53 shapes)")
    for count in frames:
        by_frame.append(milliseconds(H, f[:count]))
        print(f"{count:7} {by_frame[-1]:9.4f}")

    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    by_shape, by_batch = figure.subplots(1, 2)
    by_shape.loglog(shapes, ours, "o-", label="torchface float32, 1,000 frames")
    by_batch.loglog(frames, by_frame, "o-", label="torchface float32, 53 shapes")
    for color, (name, spent) in enumerate(theirs.items(), start=1):
        by_shape.loglog(shapes, spent, "s--", color=f"C{color}", label=f"{name}, a frame at a time")
        by_batch.axhline(spent[shapes.index(53)], linestyle="--", color=f"C{color}", label=name)
    by_shape.set(xlabel="shapes", ylabel="milliseconds a frame", xticks=shapes, xticklabels=shapes)
    by_shape.minorticks_off()
    by_batch.set(xlabel="frames in a batch", ylabel="milliseconds a frame")
    for axes in (by_shape, by_batch):
        axes.legend()
    OUT.mkdir(parents=True, exist_ok=True)
    figure.savefig(OUT / "box_qp_growth.png", dpi=120)

    assert max(left) <= 1e-4
    for count, mine, peer in zip(shapes, ours, theirs.get("PIQP", []), strict=False):
        assert count > 100 or mine < peer
    # Large batches cost no more a frame than middling ones: memory stays bounded.
    assert by_frame[-1] <= 2 * min(by_frame)

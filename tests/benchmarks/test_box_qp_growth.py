"""How the solve grows with shapes and frames; plots to out/benchmarks/."""

from __future__ import annotations

import math
import time
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
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
    qp = BoxQP(H.float())
    single, best = f.float(), math.inf
    for _ in range(3):
        begin = time.perf_counter()
        qp(single)
        best = min(best, time.perf_counter() - begin)
    return 1000 * best / len(f)


def piqp_milliseconds(H: Tensor, f: Tensor) -> float:
    piqp = pytest.importorskip("piqp")
    solver, size = piqp.DenseSolver(), len(H)
    solver.setup(H.numpy(), np.zeros(size), None, None, None, None, None, np.zeros(size), np.ones(size))
    best = math.inf
    for row in f[:20].numpy():
        begin = time.perf_counter()
        solver.update(c=row)
        solver.solve()
        best = min(best, time.perf_counter() - begin)
    return 1000 * best


def worst_residual(H: Tensor, f: Tensor) -> float:
    x = BoxQP(H.float())(f.float()).double()
    bent = x @ H.float().double() + f.float().double()
    return float((x - (x - bent / H.diagonal()).clamp(0, 1)).abs().max())


def test_growth_with_shapes_and_frames() -> None:
    shapes = [16, 32, 53, 100, 140, 200, 280]
    by_shape = []
    print(f"\n{'shapes':>7} {'ours ms':>9} {'PIQP ms':>9} {'residual':>9}   (1,000 frames, float32)")
    for count in shapes:
        H, f = blendshape_problem(count, 1000)
        by_shape.append((milliseconds(H, f), piqp_milliseconds(H, f), worst_residual(H, f)))
        print(f"{count:7} {by_shape[-1][0]:9.4f} {by_shape[-1][1]:9.4f} {by_shape[-1][2]:9.1e}")
    frames = [1, 10, 100, 1000, 10_000, 100_000]
    by_frame = []
    H, f = blendshape_problem(53, frames[-1])
    print(f"{'frames':>7} {'ours ms':>9}   a frame (53 shapes)")
    for count in frames:
        by_frame.append(milliseconds(H, f[:count]))
        print(f"{count:7} {by_frame[-1]:9.4f}")

    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.loglog(shapes, [row[0] for row in by_shape], "o-", label="torchface float32, 1,000 frames")
    left.loglog(shapes, [row[1] for row in by_shape], "s--", label="PIQP, a frame at a time")
    left.set(xlabel="shapes", ylabel="milliseconds a frame", xticks=shapes, xticklabels=shapes)
    left.minorticks_off()
    left.legend()
    right.loglog(frames, by_frame, "o-", label="torchface float32, 53 shapes")
    right.axhline(by_shape[2][1], linestyle="--", color="C1", label="PIQP")
    right.set(xlabel="frames in a batch", ylabel="milliseconds a frame")
    right.legend()
    OUT.mkdir(parents=True, exist_ok=True)
    figure.savefig(OUT / "box_qp_growth.png", dpi=120)

    assert all(row[2] <= 1e-4 for row in by_shape)
    assert all(ours < piqp for count, (ours, piqp, _) in zip(shapes, by_shape, strict=True) if count <= 100)
    # Large batches cost no more a frame than middling ones: memory stays bounded.
    assert by_frame[-1] <= 2 * min(by_frame)

"""A head model's animation as ARKit weights: the bounded solve beside what others use, on one planted FLAME.

Real takes of ARKit weights move the embedded performer, whose face is coded by a planted FLAME of 40 expression
parameters and a jaw that turns. What comes back is compared with the weights that moved it.
"""

import time
from pathlib import Path

import numpy as np
import pytest
import torch

from planted.published_heads import codes, expression_basis, flame_arrays, head
from torchface import load_take
from torchface.capture.markers import MeshSolver
from torchface.io import load_head_model_file

pytestmark = [pytest.mark.bench, pytest.mark.real]
FRAMES, PARAMETERS = 2_000, 40
MANY, VERTICES, SECONDS = 10_000, 5023, 5.0  # of one core's time


def test_the_bounded_solve_is_nearest_and_quick(performances: list[Path], tmp_path: Path) -> None:
    rig = head()
    takes = [load_take(path).weights for path in performances]
    weights = torch.cat([rig.weights_from(take) for take in takes if take is not None])[:FRAMES].clamp(0, 1).float()
    np.savez(tmp_path / "flame.npz", **flame_arrays(rig))
    model = load_head_model_file(tmp_path / "flame.npz")
    solver = MeshSolver(rig)
    jaw = torch.zeros(len(weights), 5, 3)
    jaw[:, 2, 0] = 0.35 * weights[:, rig.index(["jawOpen"])[0]]
    rest = weights.clone()
    rest[:, rig.index(["jawOpen"])] *= 0.1  # the joint opens the jaw, parameters do what is left
    code = codes(rig, expression_basis(rig), rest)[:, :PARAMETERS]

    def read(begin: int, end: int) -> torch.Tensor:
        return model.posed(model.neutral.vertices, code[begin:end], jaw[begin:end])

    meshes = torch.cat([read(i, i + 500) for i in range(0, len(weights), 500)])
    slopes, constant = (
        torch.cat(parts) for parts in zip(*(solver.equations(m) for m in meshes.split(500)), strict=True)
    )
    free = -torch.linalg.solve(solver.H, slopes.T).T
    inputs = torch.cat([code, jaw[:, 2]], 1).double()
    random = torch.randn(2000, inputs.shape[1], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    random *= inputs.std(0)
    turned = torch.zeros(len(random), 5, 3)
    turned[:, 2] = random[:, -3:].float()
    seen = model.posed(model.neutral.vertices, random[:, :-3].float(), turned)
    matrix = torch.linalg.lstsq(random, -torch.linalg.solve(solver.H, solver.equations(seen)[0].T).T).solution
    found = {"fixed matrix, clipped": (inputs @ matrix).clamp(0, 1), "least squares": free}
    found["least squares, clipped"] = free.clamp(0, 1)
    for name, temporal in (("bounded, each frame", False), ("bounded, whole take", True)):
        found[name] = solver.solve(lambda a, b: meshes[a:b], len(meshes), 60.0, temporal=temporal).weights
    apart = {name: float((one - weights).abs().mean()) for name, one in found.items()}
    error = {name: float(solver.error(slopes, constant, one).mean()) for name, one in found.items()}
    for name in found:
        print(f"{name:24s} weights {apart[name]:.4f}  {error[name]:.3f} mm")
    ours = error["bounded, each frame"]
    assert ours < error["least squares, clipped"]
    assert ours < error["fixed matrix, clipped"]
    assert apart["bounded, whole take"] < apart["fixed matrix, clipped"]


def test_ten_thousand_frames_take_seconds(performances: list[Path], one_thread: None) -> None:
    rig = head().part(torch.arange(VERTICES))
    takes = [load_take(path).weights for path in performances]
    weights = torch.cat([rig.weights_from(take) for take in takes if take is not None]).clamp(0, 1).float()
    few = rig(weights[:2000])
    solver = MeshSolver(rig)
    for temporal in (False, True):
        begin = time.process_time()
        solver.solve(lambda a, b: few[torch.arange(a, b) % len(few)], MANY, 60.0, temporal=temporal)
        seconds = time.process_time() - begin
        print(f"{MANY} frames of {VERTICES} vertices, temporal={temporal}: {seconds:.1f} s of one core")
        assert seconds < SECONDS

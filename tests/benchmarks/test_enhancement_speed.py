"""What enhancing a frame costs, part by part, at 100,000 and 500,000 vertices; how it grows; setting up; memory.

The frames only need the right sizes here: they are the smooth performer's, with a wave on top.
"""

import resource
import time
from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor

from torchface.enhancement import CapturedPerformance, EnhancementModel
from torchface.enhancement.thin_shell import ThinShell
from torchface.synthetic.stages.wrinkles import WrinkledPerformer

SIZES = {100_000: 0.2, 500_000: 1.0}
"""Vertices, and seconds a frame aimed at, on two cores."""
DATABASE, REPEATS = 60, 4


def database_frames(performer: WrinkledPerformer, count: int) -> Tensor:
    """Frames (K,V,3) of random expressions, the first of them none."""
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(count, len(performer.names), generator=generator) ** 4
    weights[0] = 0.0
    return performer.frames(weights, 30.0)


def seconds(run: Callable[[], object]) -> float:
    """Least of some runs: neighbours on the machine only add."""
    times = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return min(times)


def fitted(performer: WrinkledPerformer, frames: Tensor) -> EnhancementModel:
    sequences = torch.arange(len(frames)) * 4 // len(frames)
    return EnhancementModel.fit(
        CapturedPerformance(
            frames,
            performer.neutral.faces,
            sequences,
            performer.neutral.vertices,
            landmarks=performer.neutral.landmarks,
        )
    )


@pytest.mark.parametrize("size", SIZES)
def test_parts(size: int) -> None:
    """A frame by frame enhancement, every part timed alone in batches of eight frames."""
    performer = WrinkledPerformer(vertices=size)
    count = DATABASE if size < 200_000 else DATABASE // 3
    frames = database_frames(performer, count)
    began = time.perf_counter()
    model = fitted(performer, frames)
    setting_up = time.perf_counter() - began
    coarse = performer.smooth(torch.rand(8, len(performer.names), generator=torch.Generator().manual_seed(1)) ** 4)
    began = time.perf_counter()
    model.enhance(coarse)
    first = time.perf_counter() - began
    encoder, matching = model.prepared.encoder, model.prepared.projection
    points = torch.linspace(0, len(model.neutral) - 1, 250).long()
    shell = ThinShell(model.neutral, model.faces, points)
    with torch.no_grad():
        laid, _ = encoder.alignment.aligned(coarse, "coarse")
        low = encoder.low_pass(laid)
        turned = encoder.frames.turned(low)
        features = encoder.gradients.features(low, turned)
        details = encoder.detail.encode(model.neutral + low, coarse)
        parts = {
            "thin shell, 250 points": lambda: shell.spread((coarse - model.neutral)[:, points]),
            "alignment": lambda: encoder.alignment.aligned(coarse, "coarse"),
            "low-pass": lambda: encoder.low_pass(laid),
            "turned frames": lambda: encoder.frames.turned(low),
            "features of patches": lambda: encoder.gradients.features(low, turned),
            "projection of all regions": lambda: matching.project(features),
            "composition": lambda: encoder.detail.compose(model.neutral + low, details, turned),
            "enhance, all but the shell": lambda: model.enhance(coarse),
        }
        print(f"\n{len(model.neutral):,} vertices, {count} database frames, {len(model.region_names)} regions, "
              f"{torch.get_num_threads()} threads")  # fmt: skip
        times = {name: seconds(run) / len(coarse) for name, run in parts.items()}
    for name, value in times.items():
        print(f"{name:28s}{1000 * value:9.1f} ms a frame")
    one = seconds(lambda: model.enhance(coarse[:1]))
    print(f"{'one frame alone':28s}{1000 * one:9.1f} ms")
    print(f"set up: {setting_up:.1f} s for {count} frames ({setting_up / count:.3f} s each; at 1,000 frames about "
          f"{setting_up / count * 1000 / 60:.1f} minutes), the first call {first:.1f} s more")  # fmt: skip
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory of the process so far, the database's frames in memory included: {peak:.1f} GiB")
    assert times["thin shell, 250 points"] + times["enhance, all but the shell"] <= 2 * SIZES[size]  # a busy machine


def test_growth() -> None:
    """With the frames of the database, and with vertices."""
    rows = []
    for size, counts in ((20_000, (50, 200, 400)), (40_000, (50,)), (80_000, (50,))):
        performer = WrinkledPerformer(vertices=size)
        frames = database_frames(performer, max(counts))
        coarse = performer.smooth(torch.rand(8, len(performer.names), generator=torch.Generator().manual_seed(1)) ** 4)
        for count in counts:
            model = fitted(performer, frames[:count])
            rows.append((len(model.neutral), count, 1000 * seconds(partial(model.enhance, coarse)) / len(coarse)))
    print(f"\n{'vertices':>9s}{'database':>10s}{'ms a frame':>12s}")
    for vertices, count, value in rows:
        print(f"{vertices:9,d}{count:10d}{value:12.1f}")
    assert rows[2][2] < 8 * rows[0][2]

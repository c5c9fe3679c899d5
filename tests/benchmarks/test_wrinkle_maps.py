"""Claim: a 2048 x 2048 normal map from a scan of half a million triangles takes seconds and shows planted wrinkles."""

import importlib.util
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import pytest
import torch

from torchface.modeling import align_scan, bake_normal_map

T = TypeVar("T")


def planted() -> ModuleType:
    """The head with wrinkles that the tests of ``modeling.detail`` use."""
    file = Path(__file__).resolve().parents[1] / "modeling" / "detail" / "test_normal_map_baking.py"
    specification = importlib.util.spec_from_file_location("planted_wrinkles", file)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def timed(run: Callable[..., T], *arguments: object, **named: object) -> tuple[float, T]:
    start = time.perf_counter()
    result = run(*arguments, **named)
    return time.perf_counter() - start, result


@pytest.fixture
def one_thread() -> Iterator[None]:
    """On a busy machine two threads that wait for each other measure the neighbours."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_maps_in_seconds() -> None:
    head = planted()
    face, scan = head.head(), head.patch((-60, 60), (-30, 60), 510, 490, head.DEPTH)
    whole = head.patch((-179, 179), (-79, 79), 714, 350, head.DEPTH)
    away = head.moved(scan, 100, (30.0, 200, -100))
    print(f"\nmesh of {len(face.faces):,} triangles, scan of {len(scan.faces):,}; one thread")
    print(f"{'map':>6} {'seconds':>8} {'texels hit':>11} {'error':>7} {'of a turn of':>13}")
    for size in (512, 1024, 2048):
        taken, baked = timed(bake_normal_map, face, scan, size, alignment=head.still())
        error, relief = head.error_degrees(face, baked)
        print(
            f"{size:>6} {taken:>8.2f} {int(baked.hit.sum()):>11,} "
            f"{float(error.median()):>6.1f}° {float(relief.median()):>12.1f}°"
        )
        if size == 2048:
            assert float(error.median()) <= 5
    taken, baked = timed(bake_normal_map, face, whole, 2048, alignment=head.still())
    hits = int(baked.hit.sum())
    print(f"  2048 {taken:>8.2f} {hits:>11,}  from a scan of the whole head, {len(whole.faces):,} triangles")
    taken, found = timed(align_scan, face, away)
    print(f"to find the scan's place without picks: {taken:.2f} s, median distance {found.median_distance:.3f} mm")

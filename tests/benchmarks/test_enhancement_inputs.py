"""The paper's own tests, a row and a picture each: where coarse animations come from, and what becomes of them.

"Own pairs" are a model for inputs of one kind: what that kind shows of the database's frames is learned with them. The
last column is how near any detail comes that is added to the input's own smooth part: the truth's.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from enhancement_comparison import (
    INPUT,
    LEARNED,
    MOTION,
    OURS,
    PAIRS,
    PAPER,
    Bench,
    bench_of,
    fitted,
    measure,
    shares,
    total,
)
from enhancement_scenes import FPS
from torch import Tensor

from torchface import Attachment, BlendshapeRig
from torchface.capture import MarkerSolver, VideoSolver
from torchface.enhancement.thin_shell import ThinShell
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.meshes.surface_index import SurfaceIndex

pytestmark = [pytest.mark.real, pytest.mark.usefixtures("one_thread")]
EACH = 3  # test frames of which one is enhanced: 10 a second
METHODS = (INPUT, OURS, LEARNED, LEARNED + PAIRS, MOTION, PAPER)
TITLES = ("input itself", "13 regions", "learned map", "the rig's pairs", "polynomials", "paper's form")
OWN = "learned map, own pairs"


@pytest.fixture(scope="module")
def bench(data: Path) -> Bench:
    return bench_of("performer", data)


def spread_points(vertices: Tensor, where: Tensor, count: int) -> Tensor:
    """So many of some vertices (V,) bool, each the farthest from those before; ids (count,)."""
    ids = where.nonzero()[:, 0]
    chosen = [int(ids[vertices[ids, 2].argmax()])]
    distance = (vertices[ids] - vertices[chosen[0]]).norm(dim=1)
    for _ in range(count - 1):  # each needs those before it
        chosen.append(int(ids[distance.argmax()]))
        distance = torch.minimum(distance, (vertices[ids] - vertices[chosen[-1]]).norm(dim=1))
    return torch.tensor(chosen)


def face_of(bench: Bench) -> Tensor:
    """Vertices that markers can be glued to, (V,): the front of the skin."""
    neutral = bench.scene.neutral
    marks = neutral[bench.scene.performer.neutral.landmarks]
    low, high = marks.amin(0), marks.amax(0)
    return (
        bench.ruler.skin
        & (neutral[:, 1] > low[1])
        & (neutral[:, 1] < high[1] + 40)
        & (neutral[:, 2] > float(marks[:, 2].median()) - 40)
    )


def low_passed(bench: Bench, truth: Tensor, weights: Tensor) -> Tensor:
    """Figure 8: the truth itself, smoothed."""
    return bench.smooth(truth)


def markers(bench: Bench, truth: Tensor, weights: Tensor) -> Tensor:
    """Figure 9: 250 markers on the wrinkled skin, carried on by the thin shell."""
    points = spread_points(bench.scene.neutral, face_of(bench), 250)
    shell = ThinShell(bench.scene.neutral, bench.scene.faces, points)
    return bench.scene.neutral + shell.spread((truth - bench.scene.neutral)[:, points])


def other_rig(bench: Bench, truth: Tensor, weights: Tensor) -> Tensor:
    """Figures 10 and 11: the coarse rig's own mesh, with 40 of its shapes, those that move the database most."""
    rig = bench.scene.performer.rig
    size = (bench.scene.weights.amax(0) * rig.deltas.norm(dim=2).amax(1)).argsort(descending=True)
    few = torch.zeros_like(weights)
    few[:, size[:40]] = weights[:, size[:40]]
    found = SurfaceIndex(bench.scene.neutral, bench.scene.faces).nearest(rig.neutral.vertices)
    near = found.distance < 2.0
    shell = ThinShell(
        bench.scene.neutral, bench.scene.faces, Attachment(found.triangle[near], found.barycentric[near].float())
    )
    return bench.scene.neutral + shell.spread((rig(few) - rig.neutral.vertices)[:, near])


def one_camera(bench: Bench, truth: Tensor, weights: Tensor) -> Tensor:
    """Figure 12: the rig fitted to 68 landmarks of one camera's video, with half a pixel of noise at 640x480."""
    performer = bench.scene.performer
    marks = performer.neutral.landmarks
    camera = look_at(bench.scene.neutral[marks].mean(0), yaw=0.0, span=400.0, width=640, height=480)
    noise = torch.randn(len(truth), 68, 2, generator=torch.Generator().manual_seed(0))
    solver = VideoSolver(performer.rig, performer.rig.neutral.landmarks, camera.intrinsics)
    found = solver(camera.project(truth[:, marks].double()).float() + 0.5 * noise)
    return performer.smooth(found.weights.float().clamp(0, 1))


def noisy_points(bench: Bench, truth: Tensor, weights: Tensor) -> Tensor:
    """Figure 13: a rig solved from 40 points with half a millimetre of noise, sampled at them, carried on."""
    rig: BlendshapeRig = bench.scene.performer.rig
    vertices = rig.neutral.vertices
    found = SurfaceIndex(vertices, rig.neutral.faces).nearest(
        bench.scene.neutral[spread_points(bench.scene.neutral, face_of(bench), 40)]
    )
    attachment = Attachment(found.triangle, found.barycentric.float())
    seen = attachment.on(rig.neutral.faces, rig(weights))
    seen = seen + 0.5 * torch.randn(seen.shape, generator=torch.Generator().manual_seed(0))
    solved = rig(MarkerSolver(rig, attachment)(seen)) - vertices
    dense = SurfaceIndex(bench.scene.neutral, bench.scene.faces).nearest(found.points)
    shell = ThinShell(bench.scene.neutral, bench.scene.faces, Attachment(dense.triangle, dense.barycentric.float()))
    return bench.scene.neutral + shell.spread(attachment.on(rig.neutral.faces, solved))


SOURCES: dict[str, Callable[[Bench, Tensor, Tensor], Tensor]] = {
    "smoothed captures (figure 8)": low_passed,
    "250 markers (9)": markers,
    "40 shapes, other mesh (10)": other_rig,
    "one camera's video (12)": one_camera,
    "40 noisy points (13)": noisy_points,
}


KEPT = {"40 shapes, other mesh (10)"}
"""Inputs whose own fine part is wrong: a model of pairs keeps it."""


def test_sources(bench: Bench) -> None:
    """Every kind of input, ours beside polynomial maps (figure 14) and the paper's own form."""
    known = [bench.ruler.known(true[::EACH]) for true in bench.scene.truth]
    weights = [some[::EACH] for some in bench.scene.test_weights]
    head = "".join(f"{name:>22s}" for name in (*TITLES, "own pairs", "truth's detail"))
    print(f"\nfine part, share of the smooth input's; normals behind\n{'':32s}{head}")
    for source, made in SOURCES.items():
        coarse = [made(bench, true.truth, rows) for true, rows in zip(known, weights, strict=True)]
        paired = fitted(bench.scene, made(bench, bench.scene.frames, bench.scene.weights))
        both = replace(bench, methods=bench.methods | {OWN: paired})
        measured = measure(both, coarse, known, (*METHODS, OWN))
        rows = [shares(bench, measured, name) for name in (*METHODS, OWN)]
        best = total([
            bench.ruler.errors(truths_detail(bench, shown, true.truth), true)
            for shown, true in zip(coarse, known, strict=True)
        ])  # fmt: skip
        rows.append(bench.ruler.shares(best, measured.smooth, measured.flicker))
        print(f"{source:32s}" + "".join(f"{row.fine:14.3f} {row.angle:7.3f}" for row in rows))
        if source not in KEPT:
            assert rows[-2].fine < min(rows[2].fine, 0.75)


def truths_detail(bench: Bench, coarse: Tensor, truth: Tensor) -> Tensor:
    """The smooth part of coarse frames with the truth's fine part."""
    detail, low = bench.database.detail, bench.smooth(coarse)
    return detail.compose(low, detail.encode(bench.smooth(truth), truth))


def test_restored_frames(bench: Bench) -> None:
    """Frames of the database come back as they are; smoothed they are other frames, of which a third comes back."""
    some = bench.scene.frames[5::20]
    known = bench.ruler.known(some)
    smooth = bench.ruler.errors(bench.smooth(some), known)
    for what, coarse, most in (("as they are", some, 0.01), ("smoothed", bench.smooth(some), 0.70)):
        found = bench.ruler.errors(bench.model.enhance(coarse).vertices, known)
        row = bench.ruler.shares(found, smooth, known.flicker)
        print(f"\ndatabase frames {what}: fine {row.fine:.3f}, normals {row.angle:.3f} of the smooth input's")
        assert row.fine < most


def test_blends_of_two_frames(bench: Bench) -> None:
    """Figure 6: halfway between two expressions that were captured."""
    generator = torch.Generator().manual_seed(3)
    pairs = torch.randint(len(bench.scene.weights), (20, 2), generator=generator)
    weights = bench.scene.weights[pairs].mean(1)
    performer = bench.scene.performer
    truth = torch.cat([performer.frames(row[None], FPS) for row in weights])
    known = [bench.ruler.known(truth)]
    measured = measure(bench, [performer.smooth(weights)], known, METHODS)
    left = {name: shares(bench, measured, name).fine for name in METHODS}
    print("\nhalfway between two database frames: " + ", ".join(f"{name} {share:.3f}" for name, share in left.items()))
    assert left[LEARNED] < 0.32 * left[INPUT]
    assert left[LEARNED + PAIRS] < 0.06
    used = bench.model.enhance(performer.smooth(weights)).weights
    active = float((used > 0.02).sum(2).float().mean())
    print(f"frames that take part in a region: {active:.1f} on average (figure 11)")
    assert 4 < active < 12

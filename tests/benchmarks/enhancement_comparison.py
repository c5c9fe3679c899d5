"""Every way to enhance an animation, on one performer, measured alike."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import torch
from enhancement_measures import Errors, Known, Ruler, Shares
from enhancement_peers import (
    Database,
    Method,
    PapersForm,
    convex,
    holistic,
    nearest_frame,
    polynomial_maps,
    ridge_on_components,
)
from enhancement_scenes import FPS, Scene, make_scene
from torch import Tensor

from torchface.enhancement import CapturedPerformance, EnhancementModel, EnhancementSettings
from torchface.enhancement.enhancement_settings import Matching
from torchface.geometry.meshes.operators import triangle_areas

VERTICES, FRAMES = 20_000, 200
LEAST_RELIEF = 2.0  # micrometres that the smooth input must lack in a region
INPUT, NEAREST, HOLISTIC, FOUR = "coarse animation itself", "nearest frame", "holistic convex", "4 voluntary regions"
OURS, RIDGE, MOTION, STRAIN = (
    "13 regions, ours",
    "ridge, 60 components",
    "polynomials of motion",
    "polynomials of strain",
)
PAPER, PAIRS = "the paper's own form", ", from pairs"
LEARNED = "13 regions and learned map, ours"
SHOWN = (OURS, LEARNED, LEARNED + PAIRS, RIDGE, MOTION, PAPER)


@dataclass(frozen=True, eq=False)
class Bench:
    """A scene, its models (alone, and from pairs with what the rig shows), every method, and what measures them."""

    scene: Scene
    model: EnhancementModel
    paired: EnhancementModel
    database: Database
    ruler: Ruler
    methods: Mapping[str, Method]
    regions: Mapping[str, Tensor]

    def smooth(self, coarse: Tensor) -> Tensor:
        """What is left of the coarse animation when it is smoothed: what methods start from."""
        return self.database.smooth(coarse)


@dataclass(frozen=True, eq=False)
class Measured:
    """Errors of each method over some clips, and of the smooth input; the truth's own flicker (V,)."""

    found: Mapping[str, Errors]
    smooth: Errors
    flicker: Tensor
    seconds: Mapping[str, float]


@lru_cache(maxsize=1)
def bench_of(kind: str, data: Path) -> Bench:
    """Made once a performer."""
    scene = make_scene(kind, data, VERTICES, FRAMES)
    model, paired = (fitted(scene, coarse) for coarse in (None, scene.rigged))
    database = Database(scene.neutral, scene.faces, scene.frames)
    methods: dict[str, Method] = {INPUT: lambda coarse: coarse}
    methods |= ways(database, model)
    methods |= ours(model)
    methods |= {name + PAIRS: way for name, way in ways(Database(
        scene.neutral, scene.faces, scene.frames, scene.rigged), model).items()}  # fmt: skip
    methods |= {name + PAIRS: way for name, way in ours(paired).items()}
    papers = PapersForm(scene.neutral, scene.faces, scene.frames)
    methods[PAPER] = four_regions(papers, model)
    owner = model.vertex_weights.argmax(0)
    regions = {name: owner == number for number, name in enumerate(model.region_names)}
    ruler = Ruler(scene.neutral, scene.faces, database.low_pass)
    return Bench(scene, model, paired, database, ruler, methods, regions)


def fitted(scene: Scene, coarse: Tensor | None) -> EnhancementModel:
    return EnhancementModel.fit(
        CapturedPerformance(
            scene.frames,
            scene.faces,
            scene.sequences,
            scene.neutral,
            coarse=coarse,
            landmarks=scene.performer.neutral.landmarks,
        ),
        EnhancementSettings(fps=FPS),
    )


def ours(model: EnhancementModel) -> dict[str, Method]:
    """Both ways of the model to match."""

    def matched(matching: Matching, coarse: Tensor) -> Tensor:
        model.settings = replace(model.settings, matching=matching)
        return model.enhance(coarse).vertices

    return {OURS: partial(matched, "projection"), LEARNED: partial(matched, "learned")}


def four_regions(database: Database, model: EnhancementModel) -> Method:
    """The paper's choice of regions: those that the actor moves at will, whose softness covers the rest."""
    four = model.regions.voluntary
    areas = triangle_areas(model.neutral, model.faces)
    weights = model.regions.patch_weights(database.patches, areas)[four]
    shares = model.vertex_weights[four] + 1e-6  # far from all four they share alike: there little moves
    return convex(database, weights, shares / shares.sum(0))


def ways(database: Database, model: EnhancementModel) -> dict[str, Method]:
    """The peers; of the model they are given its four voluntary regions alone."""
    return {
        NEAREST: nearest_frame(database),
        HOLISTIC: holistic(database),
        FOUR: four_regions(database, model),
        RIDGE: ridge_on_components(database),
        MOTION: polynomial_maps(database, strain=False),
        STRAIN: polynomial_maps(database, strain=True),
    }


def measure(bench: Bench, coarse: Sequence[Tensor], known: Sequence[Known], only: Sequence[str] = ()) -> Measured:
    """All methods, or some, on clips."""
    found, seconds = {}, {}
    for name in only or bench.methods:
        parts = []
        for shown, true in zip(coarse, known, strict=True):
            began = time.process_time()
            enhanced = bench.methods[name](shown)
            seconds[name] = seconds.get(name, 0.0) + (time.process_time() - began) / len(shown) / len(coarse)
            parts.append(bench.ruler.errors(enhanced, true))
        found[name] = total(parts)
    smooth = total([bench.ruler.errors(bench.smooth(shown), true) for shown, true in zip(coarse, known, strict=True)])
    return Measured(found, smooth, torch.stack([true.flicker for true in known]).sum(0), seconds)


def total(parts: list[Errors]) -> Errors:
    """Of several clips together."""
    result = parts[0]
    for part in parts[1:]:
        result = result + part
    return result


def shares(bench: Bench, measured: Measured, name: str, region: str | None = None) -> Shares:
    where = None if region is None else bench.regions[region]
    return bench.ruler.shares(measured.found[name], measured.smooth, measured.flicker, where)

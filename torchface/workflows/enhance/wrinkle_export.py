"""Wrinkles for a game engine: an actor's model and a rig become maps, their weights' graphs and a ``.glb``."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchface.enhancement import EnhancementModel
from torchface.enhancement.detail.detail_basis import LearnedBasis
from torchface.enhancement.detail.detail_encodings import DisplacementDetail
from torchface.enhancement.detail.low_pass import vertex_areas
from torchface.enhancement.wrinkle_maps.wrinkle_basis import MAPS, WrinkleBasis, learn_wrinkle_basis
from torchface.enhancement.wrinkle_maps.wrinkle_teaching import captured_poses, taught_details, teaching_poses
from torchface.enhancement.wrinkle_maps.wrinkle_weights import RigWrinkles, WrinkleWeights
from torchface.errors import FileFormatError, TopologyError, ValueRangeError
from torchface.files.documents import write_json
from torchface.files.job_lock import holds_out, within_job
from torchface.files.whole_files import make_folder
from torchface.geometry.meshes.rasterization import rasterise_uvs
from torchface.geometry.meshes.region_maps import RegionMaps
from torchface.geometry.similarity import Similarity
from torchface.io import load_rig, load_take, save_animation, save_image16, save_normal_map, save_rig
from torchface.io.tables.csv_table import write_table
from torchface.mesh import Mesh
from torchface.modeling.detail.normal_map_baking import NormalMap, bake_normal_map
from torchface.number_checks import checked_count
from torchface.onnx import ExportReport, export_wrinkle_weights
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take
from torchface.workflows.enhance.coarse_animation import OTHER_ACTOR_MM
from torchface.workflows.enhance.coarse_input import CORRESPONDENCE
from torchface.workflows.enhance.enhance_animation import STATE, SUMMARY, load_model
from torchface.workflows.enhance.rig_on_model import RigOnModel, rig_on_model

GLB, BY_WEIGHTS, BY_VERTICES = "wrinkles.glb", "map_weights.onnx", "map_weights_of_vertices.onnx"
TRACK, PICTURES = "map_weights.csv", "maps"
_FORMAT = "torchface.wrinkle-maps/1"
_LEFT_OUT = 5  # of so many poses one is not learned from, to measure on
_CHECKED = 20  # poses that the graphs are checked with
_POORLY_SHOWN = 0.5
MOST_MAPS = 12
SIZES = (64, 8192)
BEYOND_SHAPES = 20


@dataclass(frozen=True)
class WrinkleSettings:
    """What is made."""

    maps: int = MAPS  # how many
    size: int = 1024  # of each, texels a side
    poses: int = 300
    pairs: Path | None = None  # vertices of the rig and where they lie on the model; found by registration if absent
    part: str | None = None  # keep this annotated region of the rig only
    animation: Path | None = None  # weights that the .glb plays, with the maps' weights beside it


@dataclass(frozen=True, eq=False)
class ExportedWrinkles:
    """What was made, and how much of the actor's detail it shows."""

    maps: RegionMaps
    wrinkles: WrinkleWeights
    # Of the model's detail on poses whose weights were not learned, with the best weights, root mean square, as a
    # share.
    missed_by_maps: float
    missed: float  # the same with the weights that are found for them
    graphs: tuple[ExportReport, ...]  # how the graphs were checked
    products: dict[str, Path]
    notes: tuple[str, ...]  # lines for people to read; warnings begin with warning:

    def lines(self) -> list[str]:
        """For people to read."""
        size = "x".join(map(str, self.maps.neutral.shape[1:]))
        return [
            f"{len(self.maps.normals)} maps of {size} texels, {len(self.maps.regions)} regions: "
            f"{len(self.maps.regions) * len(self.maps.normals)} weights a frame",
            f"of the model's detail the maps lack {self.missed_by_maps:.0%} with the best weights, {self.missed:.0%} "
            "with those found for poses that were not learned (root mean square)",
            *(line for graph in self.graphs for line in str(graph).splitlines()),
            *self.notes,
        ]


@holds_out(within_job)
def export_wrinkles(
    model_name: str,
    rig_path: Path,
    out: Path,
    settings: WrinkleSettings = WrinkleSettings(),
    progress: Progress | None = None,
) -> ExportedWrinkles:
    """Learns, bakes and writes; see ``torchface export enhancement --help`` for the arguments."""
    progress = silent if progress is None else progress
    checked_count("--maps", settings.maps, 1, MOST_MAPS)
    checked_count("--size", settings.size, *SIZES)
    progress("reading model and rig")
    model = load_model(model_name)
    rig = load_rig(rig_path, part=settings.part)
    if rig.neutral.uvs is None or rig.neutral.uv_faces is None:
        raise TopologyError(f"{rig_path}: found a rig without texture coordinates, expected some to bake maps into")
    if not rig.names:
        raise TopologyError(f"{rig_path}: found a mesh without shapes, expected a rig to move")
    checked_count("--poses", settings.poses, len(rig.names) + BEYOND_SHAPES)
    take = None if settings.animation is None else _take(settings.animation)
    played = None if take is None or take.weights is None else rig.weights_from(take.weights).float()
    state = make_folder(out / STATE)
    surface = Mesh(model.neutral, model.faces)
    placed = rig_on_model(rig, rig_path, surface, settings.pairs, state / CORRESPONDENCE, progress)
    if not placed.correspondence.how and placed.correspondence.residual > OTHER_ACTOR_MM:
        model, placed, surface = _on_actor(model, placed)
    shares = placed.carried(model.vertex_weights, surface)
    poses, details = _taught(model, placed, shares, settings.poses, progress)
    progress("learning maps")
    basis = learn_wrinkle_basis(
        details, model.vertex_weights, vertex_areas(model.neutral, model.faces).float(), settings.maps
    )
    wrinkles, missed_by_maps, missed = _learned(basis, details, placed, poses, shares, model.region_names, progress)
    maps = bake_region_maps(
        placed.neutral, surface, basis.maps, shares, model.region_names, placed.scale, settings.size, progress
    )
    progress("writing")
    products, graphs = _write(out, maps, wrinkles, rig, poses, take, played)
    notes = list(placed.notes)
    if missed > _POORLY_SHOWN:
        notes.append(
            f"warning: the maps lack {missed:.0%} of the model's detail in poses that were not learned; more poses "
            "(--poses) or maps (--maps) would show more"
        )
    done = ExportedWrinkles(maps, wrinkles, missed_by_maps, missed, graphs, products, tuple(notes))
    write_json(out / SUMMARY, _summary(done, model_name, rig_path, len(poses)))
    return done


def _take(path: Path) -> Take:
    take = load_take(path)
    if take.weights is None or not len(take.weights):
        raise FileFormatError(f"{path}: found no weights, expected an animation of the rig's shapes")
    if not bool(torch.isfinite(take.weights.values).all()):
        raise ValueRangeError(f"{path}: found NaN or infinite weights, expected numbers")
    return take


def _on_actor(model: EnhancementModel, placed: RigOnModel) -> tuple[EnhancementModel, RigOnModel, Mesh]:
    """The model's detail for the rig's own head."""
    head = placed.dense(placed.rig.vertices[None])[0]
    placed = replace(placed, correspondence=replace(placed.correspondence, bent=head))
    return model.on_actor(head), placed, Mesh(head, model.faces)


def _taught(
    model: EnhancementModel, placed: RigOnModel, shares: Tensor, count: int, progress: Progress
) -> tuple[Tensor, LearnedBasis]:
    """Poses of the rig (K,N), and what the model adds to them."""
    rig = placed.rig

    def dense(weights: Tensor) -> Tensor:
        with torch.no_grad():
            return placed.dense(rig(weights))

    shapes = []
    for number, one in enumerate(torch.eye(len(rig.names)).split(1)):  # a shape at a time bounds the memory
        shapes.append(model.features(dense(one)))
        progress("posing the rig as the actor", number + 1, len(rig.names))
    captured = captured_poses(model, torch.cat(shapes))
    moved = shares @ rig.deltas.square().sum(-1).T
    poses = teaching_poses(captured, moved, count)
    return poses, taught_details(model, lambda begin, end: dense(poses[begin:end]), len(poses), progress)


def _learned(
    basis: WrinkleBasis,
    details: LearnedBasis,
    placed: RigOnModel,
    poses: Tensor,
    shares: Tensor,
    regions: tuple[str, ...],
    progress: Progress,
) -> tuple[WrinkleWeights, float, float]:
    """Weights of the rig's vertices; what the maps lack, and what they lack with such weights."""
    progress("learning their weights")
    weights, sites = basis.weights(details), placed.sites()
    with torch.no_grad():
        posed = torch.cat([placed.rig(some)[:, sites] for some in poses.split(16)])
        # What a shape does that was never seen alone cannot be known: of the poses after these some are left out.
        row = torch.arange(len(poses)) - len(placed.rig.names)
        left_out = (row >= 0) & (row % _LEFT_OUT == _LEFT_OUT - 1)
        neutral, near = placed.rig.vertices[sites], shares[:, sites]
        measured = WrinkleWeights.fit(neutral, posed[~left_out], weights[~left_out], near, regions)
        rows = LearnedBasis(details.components, details.coefficients[left_out], details.lost_share)
        missed = basis.missed_share(measured(posed[left_out]), rows)
        wrinkles = WrinkleWeights.fit(neutral, posed, weights, near, regions)
    return wrinkles.of_whole(sites, len(placed.rig.vertices)), basis.missed_share(weights[left_out], rows), missed


def _write(
    out: Path,
    maps: RegionMaps,
    wrinkles: WrinkleWeights,
    rig: BlendshapeRig,
    poses: Tensor,
    take: Take | None,
    played: Tensor | None,
) -> tuple[dict[str, Path], tuple[ExportReport, ...]]:
    products = {"rig with maps": out / GLB, "map weights of blendshape weights": out / BY_WEIGHTS}
    products |= {"map weights of the rig's vertices": out / BY_VERTICES, "maps": out / PICTURES}
    by_rig = RigWrinkles(wrinkles, rig)
    facts = {"maps": [f"wrinkle_{i}" for i in range(len(maps.normals))]}
    some = poses[torch.linspace(0, len(poses) - 1, _CHECKED).round().long()]
    with torch.no_grad():
        graphs = (
            export_wrinkle_weights(by_rig, some, out / BY_WEIGHTS, facts),
            export_wrinkle_weights(wrinkles, rig(some), out / BY_VERTICES, facts),
        )
    _write_pictures(maps, make_folder(out / PICTURES))
    if take is None or played is None:
        save_rig(rig, out / GLB, maps)
        return products, graphs
    save_animation(rig, take, out / GLB, maps)
    with torch.no_grad():
        values = by_rig(played).flatten(1)
    header = [f"{region}.{name}" for region in maps.regions for name in facts["maps"]]
    rows = (
        [f"{time:.6g}", *(f"{value:.5g}" for value in row)]
        for time, row in zip(take.times.tolist(), values.tolist(), strict=True)
    )
    write_table(out / TRACK, ["seconds", *header], rows)
    return products | {"map weights of the animation": out / TRACK}, graphs


def _write_pictures(maps: RegionMaps, folder: Path) -> None:
    """The maps as PNG of 16 bits, for engines that take no ``.glb``."""
    save_normal_map(maps.neutral, folder / "neutral_normals.png")
    low, high = float(maps.heights.min()), float(maps.heights.max())
    for number, (normals, heights) in enumerate(zip(maps.normals, maps.heights, strict=True)):
        save_normal_map(normals, folder / f"wrinkle_{number}_normals.png")
        grey = (heights - low) / max(high - low, 1e-6)
        save_image16(grey.expand(3, -1, -1), folder / f"wrinkle_{number}_heights.png")
    for name, mask in zip(maps.regions, maps.masks, strict=True):
        save_image16(mask.expand(3, -1, -1), folder / f"mask_{name}.png")


def _summary(done: ExportedWrinkles, model_name: str, rig: Path, poses: int) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "model": model_name,
        "rig": rig.name,
        "regions": list(done.maps.regions),
        "maps": len(done.maps.normals),
        "size": list(done.maps.neutral.shape[1:]),
        "height_range_mm": [float(done.maps.heights.min()), float(done.maps.heights.max())],
        "poses": poses,
        "missed_share_with_best_weights": done.missed_by_maps,
        "missed_share_with_found_weights": done.missed,
        "notes": list(done.notes),
        "files": {what: path.name for what, path in done.products.items()},
    }


_MASK_SHARE = 4  # a mask is smooth: it has a quarter of the maps' texels a side
_LEAST_MASK = 64


def bake_region_maps(
    mesh: Mesh,
    model: Mesh,
    displacements: Tensor,
    shares: Tensor,
    regions: tuple[str, ...],
    scale: float,
    size: int,
    progress: Progress,
) -> RegionMaps:
    """Bakes the actor's face at rest, and with each map of displacements (M,3,V), along the neutral's tangents and
    normal, at 1.

    ``shares`` (R,N) are of the regions in the rig's vertices, ``scale`` is from the rig's millimetres to the model's.
    """
    still = Similarity(
        torch.ones(1, dtype=torch.float64),
        torch.eye(3, dtype=torch.float64)[None],
        torch.zeros(1, 3, dtype=torch.float64),
    )
    detail = DisplacementDetail(model.vertices, model.faces)
    count = len(displacements)

    def baked(number: int, vertices: Tensor) -> NormalMap:
        progress("baking maps", number, count + 1)
        return bake_normal_map(mesh, model.with_vertices(vertices), size, alignment=still)

    rest = baked(0, model.vertices)
    normals, heights = [], []
    for number, one in enumerate(displacements, start=1):  # a bake is minutes of rays at large sizes
        shown = baked(number, detail.compose(model.vertices[None], one.flatten()[None])[0])
        both = rest.hit & shown.hit
        normals.append(torch.where(both, shown.normals, rest.normals))
        heights.append(torch.where(both, shown.heights - rest.heights, 0.0) / scale)
    progress("baking maps", count + 1, count + 1)
    masks = _masks(mesh, shares, max(_LEAST_MASK, size // _MASK_SHARE))
    return RegionMaps(regions, torch.stack(normals), torch.stack(heights), masks, rest.normals)


def _masks(mesh: Mesh, shares: Tensor, size: int) -> Tensor:
    """Values (R,N) of the vertices in texture space, (R,size,size), grown over the whole texture."""
    assert mesh.uvs is not None
    assert mesh.uv_faces is not None
    texels = rasterise_uvs(mesh.uvs, mesh.uv_faces, size, size)
    return texels.image(texels.interpolate(shares.T.double(), mesh.faces), size).clamp(0, 1)

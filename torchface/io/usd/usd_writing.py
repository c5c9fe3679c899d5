"""Meshes, rigs and their animations as USD: metres, y up, shapes as UsdSkel's blend shapes."""

import json
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchface.color_space import to_linear
from torchface.errors import FileFormatError, TopologyError
from torchface.files.files_beside import free_stem, write_beside
from torchface.files.whole_files import all_or_none, replaced_file
from torchface.files.write_errors import unwritten
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io.gltf.corrective_extras import write_correctives
from torchface.io.gltf.detail_textures import check_detail
from torchface.io.gltf.mesh_extras import write_extras
from torchface.io.gltf.primitive_writing import metres, shading_normals, shown_motion
from torchface.io.meshes.polygons import corners_of_polygons
from torchface.io.scenes.weight_keys import WeightKeys, with_correctives
from torchface.io.usd.material_prims import write_materials, write_wrinkles
from torchface.io.usd.usd_library import usd_library
from torchface.mesh import Mesh
from torchface.rig import BlendshapeRig

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
NOTES = "torchface"  # the key of a mesh prim's customData under which annotations and the like are kept, as JSON

_ROOT, _MESH, _SKELETON, _ANIMATION = "/rig", "/rig/face", "/rig/skeleton", "/rig/performance"


def write_usd_rig(
    rig: BlendshapeRig, path: str | Path, keys: WeightKeys | None = None, detail: DetailMaps | None = None
) -> None:
    """Writes a rig as USD in metres: one mesh in the rig's order of vertices and polygons, a ``BlendShape`` a shape.

    The mesh lies with a skeleton without joints, through which UsdSkel finds the animation, under one ``SkelRoot``.
    Names of shapes are the tokens of ``skel:blendShapes``; the prims have the names that USD allows. In-betweens are
    UsdSkel's own. A combination, which USD does not know, is a blend shape after the others, whose weights the
    animation holds; what drives it is noted in the mesh's ``customData`` with the annotations: the string
    ``torchface``, JSON with ``"correctives": [{"name": ..., "drivers": [...]}]``. Shapes carry offsets of positions and
    normals for the vertices that they move; what moves less than 0.1 micrometre and rotates a normal less than 8 bits
    of shading show is left out.

    Args:
        path: ``.usda`` is text, ``.usdc`` and ``.usd`` are binary, with the texture as a PNG of the same name beside
            them, and images of eyes and lashes that no texture shows; ``.usdz`` holds all. It appears only when it is
            complete. A picture of the user's of such a name is kept: those of the file get another, with a warning.
        keys: an animation of its shapes, by way of ``skel:animationSource``; a frame is a time code.
        detail: detail maps of its shapes; see ``write_wrinkles``.
    """
    if detail is not None:
        check_detail(detail, rig.neutral, rig.names)
    _write(path, rig.neutral, rig, keys, detail)


def write_usd_mesh(mesh: Mesh, path: str | Path) -> None:
    """Writes a mesh as USD in metres; see :func:`write_usd_rig`."""
    _write(path, mesh, None, None, None)


def _write(
    path: str | Path, mesh: Mesh, rig: BlendshapeRig | None, keys: WeightKeys | None, detail: DetailMaps | None
) -> None:
    path, usd = Path(path), usd_library()
    if len(mesh.faces) == 0:
        raise TopologyError(f"{path}: the mesh has no triangle; USD's readers need one")
    mesh = mesh.to("cpu")
    stem = re.sub(r"[^\w.-]", "_", path.stem)  # USD reads more into some signs
    packed = path.suffix.lower() == ".usdz"
    with _usd_errors(path, usd), tempfile.TemporaryDirectory(prefix="torchface-usd-") as folder:
        layer = Path(folder, stem + (".usda" if path.suffix.lower() == ".usda" else ".usdc"))
        stage = usd.Usd.Stage.CreateInMemory()
        images = _fill(usd, stage, mesh, rig, keys, detail, stem)
        if not packed and (free := free_stem(path, stem, images)) != stem:
            stage = usd.Usd.Stage.CreateInMemory()
            images = _fill(usd, stage, mesh, rig, keys, detail, free)
        if not stage.GetRootLayer().Export(str(layer)):
            raise FileFormatError(f"{path}: cannot be written (USD could not export it to {folder})")
        if packed:
            for name, data in images.items():
                Path(folder, name).write_bytes(data)
            layer = _package(usd, layer)
        with all_or_none():
            write_beside(path, {} if packed else images)
            with replaced_file(path) as temporary:
                shutil.copyfile(layer, temporary)


def _package(usd: Any, layer: Path) -> Path:
    package = layer.with_suffix(".usdz")
    if not usd.UsdUtils.CreateNewUsdzPackage(str(layer), str(package)):
        raise FileFormatError(f"{package.name}: cannot be written (USD could not pack it)")
    return package


@contextmanager
def _usd_errors(path: Path, usd: Any) -> Iterator[None]:
    try:
        yield
    except usd.Tf.ErrorException as error:
        said = re.findall(r" : '(.*)'", str(error))
        raise FileFormatError(
            f"{path}: cannot be written: OpenUSD failed in {tempfile.gettempdir()} (is its disk full?): "
            f"{said[0] if said else error!s:.200}"
        ) from error
    except OSError as error:  # of the temporary folder
        raise unwritten(path, error) from error


def _fill(
    usd: Any,
    stage: Any,
    mesh: Mesh,
    rig: BlendshapeRig | None,
    keys: WeightKeys | None,
    detail: DetailMaps | None,
    stem: str,
) -> dict[str, bytes]:
    """Puts all into a stage; the images that belong beside it, by name."""
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.y)
    kind = usd.UsdGeom.Xform if rig is None else usd.UsdSkel.Root
    root = kind.Define(stage, _ROOT).GetPrim()
    usd.Usd.ModelAPI(root).SetKind("component")
    stage.SetDefaultPrim(root)
    prim = _mesh(usd, stage, mesh)
    images, face = write_materials(usd, stage, prim, mesh, _ROOT, stem)
    notes = write_extras(mesh)
    if detail is not None:
        maps, listed = write_wrinkles(usd, stage, face, detail, stem)
        images, notes = images | maps, notes | listed
    notes.pop("polygons", None)  # the mesh has them
    if rig is not None:
        targets = _targets(rig)
        names = [target.name for target in targets]
        tokens = _tokens(names)
        if tokens != names:
            notes["shapes"] = names
        if rig.correctives is not None:
            notes |= write_correctives(rig.correctives.definitions)
        shapes = _shapes(usd, stage, mesh, targets, tokens)
        usd.UsdSkel.Root(root).CreateExtentAttr(_vectors(usd, metres(_reach(mesh, rig).numpy())))
        _bind(usd, stage, prim, tokens, shapes, None if keys is None else _with_combinations(rig, keys))
    prim.SetCustomDataByKey(NOTES, json.dumps(notes, separators=(",", ":")))
    return images


def _mesh(usd: Any, stage: Any, mesh: Mesh) -> Any:
    sizes, corners, uv_corners = corners_of_polygons(mesh)
    points = metres(mesh.vertices.detach().numpy())
    made = usd.UsdGeom.Mesh.Define(stage, _MESH)
    made.CreateSubdivisionSchemeAttr(usd.UsdGeom.Tokens.none)  # the polygons are the surface, as everywhere else
    made.CreateDoubleSidedAttr(True)
    made.CreatePointsAttr(_vectors(usd, points))
    made.CreateExtentAttr(_vectors(usd, np.stack([points.min(0), points.max(0)])))
    made.CreateFaceVertexCountsAttr(usd.Vt.IntArray.FromNumpy(sizes.astype(np.int32)))
    made.CreateFaceVertexIndicesAttr(usd.Vt.IntArray.FromNumpy(corners.astype(np.int32)))
    made.CreateNormalsAttr(_vectors(usd, shading_normals(mesh.vertices.detach().double(), mesh.faces).float().numpy()))
    made.SetNormalsInterpolation(usd.UsdGeom.Tokens.vertex)
    primvars = usd.UsdGeom.PrimvarsAPI(made)
    if mesh.uvs is not None:
        kind = usd.Sdf.ValueTypeNames.TexCoord2fArray
        uvs = primvars.CreatePrimvar("st", kind, usd.UsdGeom.Tokens.faceVarying)
        uvs.Set(usd.Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uvs.detach().float().numpy())))
        uvs.SetIndices(usd.Vt.IntArray.FromNumpy(uv_corners.astype(np.int32)))
    if mesh.colors is not None:
        light = to_linear(mesh.colors.detach().float().clamp(0, 1)).numpy()
        colors = made.CreateDisplayColorPrimvar(usd.UsdGeom.Tokens.vertex)
        colors.Set(_vectors(usd, light))
    return made.GetPrim()


@dataclass(frozen=True)
class _Target:
    """A blend shape: its name, where it leads (V,3), and the in-betweens on its way, name, weight and place (V,3)."""

    name: str
    delta: Tensor
    between: tuple[tuple[str, float, Tensor], ...] = ()


def _targets(rig: BlendshapeRig) -> list[_Target]:
    """The rig's shapes with their in-betweens, then its combinations."""
    deltas = dict(zip(rig.names, rig.deltas.detach().cpu().double(), strict=True))
    between: dict[str, list[tuple[str, float, Tensor]]] = {}
    combinations = []
    if (correctives := rig.correctives) is not None:
        for corrective, delta in zip(correctives.definitions, correctives.deltas.detach().cpu().double(), strict=True):
            if corrective.peak is None:
                combinations.append(_Target(corrective.name, delta))
            else:
                driver = corrective.drivers[0]
                between.setdefault(driver, []).append(
                    (corrective.name, corrective.peak, corrective.peak * deltas[driver] + delta)
                )
    shapes = [_Target(name, delta, tuple(between.get(name, ()))) for name, delta in deltas.items()]
    return [*shapes, *combinations]


def _with_combinations(rig: BlendshapeRig, keys: WeightKeys) -> WeightKeys:
    """Keys of all blend shapes: USD blends in-betweens itself, combinations get what the shapes' weights call for."""
    if rig.correctives is None:
        return keys
    shapes = range(len(rig.names))
    combined = [row for row, one in enumerate(rig.correctives.definitions, len(shapes)) if not one.is_in_between]
    return replace(keys, weights=with_correctives(rig, keys).weights[:, [*shapes, *combined]])


def _reach(mesh: Mesh, rig: BlendshapeRig) -> Tensor:
    """The box (2,3) of the mesh at rest and in each shape, millimetres."""
    rest = mesh.vertices.detach().float()
    moved = rest + rig.deltas.detach().cpu().float()
    low, high = moved.amin((0, 1)), moved.amax((0, 1))
    return torch.stack([torch.minimum(low, rest.amin(0)), torch.maximum(high, rest.amax(0))])


def _shapes(usd: Any, stage: Any, mesh: Mesh, targets: Sequence[_Target], tokens: Sequence[str]) -> list[Any]:
    normals = shading_normals(mesh.vertices.detach().double(), mesh.faces)
    used: set[str] = set()
    paths = []
    for token, target in zip(tokens, targets, strict=True):  # all normals at once would fill the memory
        reached = [target.delta, *(place for _, _, place in target.between)]
        poses = [shown_motion(mesh, normals, delta) for delta in reached]
        rows = np.flatnonzero(np.any([(moved != 0) | (rotated != 0) for moved, rotated in poses], axis=(0, 2)))
        rows = rows if len(rows) else np.zeros(1, np.int64)  # Blender leaves a shape without any offset out
        shape = usd.UsdSkel.BlendShape.Define(stage, f"{_MESH}/{free_name(usd.Tf.MakeValidIdentifier(token), used)}")
        shape.CreateOffsetsAttr(_vectors(usd, metres(poses[0][0][rows])))
        shape.CreateNormalOffsetsAttr(_vectors(usd, poses[0][1][rows]))
        shape.CreatePointIndicesAttr(usd.Vt.IntArray.FromNumpy(rows.astype(np.int32)))
        names: set[str] = set()
        for (name, weight, _), (moved, rotated) in zip(target.between, poses[1:], strict=True):
            between = shape.CreateInbetween(free_name(usd.Tf.MakeValidIdentifier(name), names))
            between.SetWeight(weight)
            between.SetOffsets(_vectors(usd, metres(moved[rows])))
            between.CreateNormalOffsetsAttr(_vectors(usd, rotated[rows]))
        paths.append(shape.GetPath())
    return paths


def _bind(usd: Any, stage: Any, prim: Any, tokens: list[str], shapes: list[Any], keys: WeightKeys | None) -> None:
    """Shapes to the mesh, the mesh to the skeleton, the skeleton to the animation."""
    skeleton = usd.UsdSkel.Skeleton.Define(stage, _SKELETON)
    skeleton.CreateJointsAttr([])
    skeleton.CreateBindTransformsAttr([])
    skeleton.CreateRestTransformsAttr([])
    binding = usd.UsdSkel.BindingAPI.Apply(prim)
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateBlendShapesAttr(tokens)
    binding.CreateBlendShapeTargetsRel().SetTargets(shapes)
    if keys is None:
        return
    animation = usd.UsdSkel.Animation.Define(stage, _ANIMATION)
    animation.CreateBlendShapesAttr(tokens)
    source = usd.UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel()
    source.SetTargets([animation.GetPath()])
    weights = animation.CreateBlendShapeWeightsAttr()
    codes = (keys.seconds * keys.fps).numpy()
    codes = np.where(np.abs(codes - codes.round()) < 1e-6, codes.round(), codes)
    for code, row in zip(codes.tolist(), keys.weights.numpy(), strict=True):  # USD takes one sample at a time
        weights.Set(usd.Vt.FloatArray.FromNumpy(np.ascontiguousarray(row)), code)
    stage.SetTimeCodesPerSecond(keys.fps)
    stage.SetFramesPerSecond(keys.fps)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])


def _tokens(names: Sequence[str]) -> list[str]:
    """The names as USD's tokens, which may be neither empty nor hold a NUL, no token twice."""
    used: set[str] = set()
    return [free_name(name.replace("\0", "") or "shape", used) for name in names]


def free_name(name: str, used: set[str]) -> str:
    """``name``, or with the first number behind it that makes it new."""
    free, number = name, 2
    while free in used:
        free, number = f"{name}_{number}", number + 1
    used.add(free)
    return free


def _vectors(usd: Any, rows: NDArray[np.float32]) -> Any:
    return usd.Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, dtype=np.float32))

"""The process that reads a USD file: run by its path, with OpenUSD and NumPy alone, never imported by the library.

``python stage_process.py FILE FOLDER`` writes ``scene.json`` and ``arrays.npz`` (see
``torchface.io.scene_processes.scene_arrays``) into the folder, or ``refused.json``, a list of what was found and what
was expected; with ``--maps`` before FILE those of its detail maps (see ``extract_maps``). OpenUSD is C++ that trusts
its files: here a crash, a count of gigabytes or an endless composition ends a process that has nothing to lose.
"""

from __future__ import annotations

import json
import os
import posixpath
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ENDINGS = (".usd", ".usda", ".usdc", ".usdz")

_MEMORY_ALWAYS, _MEMORY_A_BYTE = 500 * 2**20, 20
_OUTPUT_ALWAYS, _OUTPUT_A_BYTE = 2**27, 8
_SECONDS_ALWAYS, _SECONDS_A_MEGABYTE = 5, 2
_WALL_ALWAYS, _WALL_A_MEGABYTE = 120, 10
_PR_SET_PDEATHSIG = 1  # of Linux
_MAX_LAYERS, _MAX_PRIMS, _MAX_MESHES = 256, 200_000, 4096
_LARGEST_FILE = 2**31
_NOTES, _PAINTED, _WRINKLE_MAPS = "torchface", "torchface_painted", "wrinkleMaps"
_UV_NAMES = ("st", "UVMap", "st0", "map1", "uv", "uvs")
_COORDINATES = "UsdPrimvarReader_float2"


class Refused(Exception):
    """The file cannot be read: what was found, and what was expected."""

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(found, expected)
        self.found, self.expected = found, expected


def extract(path: Path, limit: Callable[[int], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A USD scene as what JSON can hold, and arrays by name; see ``torchface.io.scene_processes.scene_arrays``.

    Args:
        path: the root layer, or a package.
        limit: called with the bytes of all files so far, before the next is opened.
    """
    from pxr import Usd, UsdGeom

    with _refusals():
        layers, stage = _opened(path, limit)
        scene: dict[str, Any] = {
            "metres_per_unit": float(UsdGeom.GetStageMetersPerUnit(stage)),
            "up": str(UsdGeom.GetStageUpAxis(stage)),
            "meshes": [],
            "bytes": layers.size,
        }
        arrays: dict[str, Any] = {}
        animations = []
        transforms = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
        for prim in _mesh_prims(stage):
            number = len(scene["meshes"])
            if number == _MAX_MESHES:
                raise Refused(f"more than {_MAX_MESHES} meshes", "a rig")
            reader = _MeshReader(stage, prim, layers)
            record = reader.read(transforms)
            if record is None:
                continue
            scene["meshes"].append(record)
            arrays |= {f"{number}/{name}": array for name, array in reader.arrays.items()}
            if (found := reader.animation()) is not None and found not in animations:
                animations.append(found)
        if not scene["meshes"]:
            raise Refused("no mesh in its scene", "at least one with faces")
        scene["animation"] = _weights(stage, animations, arrays)
        if len(layers.images) > 1:
            shown = ", ".join(_shown(posixpath.basename(name).rstrip("]"), 40) for name in layers.images[:5])
            layers.leave(f"{len(layers.images)} textures ({shown}), of which a mesh has one: the first is taken")
        scene["left_out"] = layers.left_out
        return scene, arrays


def extract_maps(path: Path, limit: Callable[[int], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The detail maps of the first mesh that has some: names of ``shapes``, and images, encoded.

    Images are named ``0``, ``1`` and so on by the shape that they belong to, and ``neutral``. Arguments and errors as
    of :func:`extract`.
    """
    with _refusals():
        layers, stage = _opened(path, limit)
        found: tuple[list[str], dict[str, Any]] = [], {}
        for number, prim in enumerate(_mesh_prims(stage)):
            if found[1] or number == _MAX_MESHES:
                break
            found = _MeshReader(stage, prim, layers).maps()
        return {"shapes": found[0], "bytes": layers.size, "left_out": layers.left_out}, found[1]


def _opened(path: Path, limit: Callable[[int], None]) -> tuple[_Layers, Any]:
    from pxr import Sdf, Usd

    layers = _Layers(path, limit)
    layers.open_all()
    stage = Usd.Stage.Open(Sdf.Layer.FindOrOpen(str(path)), Usd.Stage.LoadAll)
    layers.check(stage)
    return layers, stage


@contextmanager
def _refusals() -> Iterator[None]:
    """Refuses what OpenUSD raises."""
    from pxr import Tf

    try:
        yield
    except Tf.ErrorException as error:
        raise Refused(_shown(_said(error), 300), "a whole USD file") from error
    except (RuntimeError, ValueError, TypeError) as error:  # prims that are gone, text that is no UTF-8, other types
        raise Refused(f"what OpenUSD does not give as it should ({_shown(error, 200)})", "a whole USD file") from error


class _Layers:
    """A root layer and the layers that it is composed of, each opened once, in the root's folder or package."""

    def __init__(self, root: Path, limit: Callable[[int], None]) -> None:
        self.root, self.folder, self.limit = root, os.path.realpath(root.parent), limit
        self.size = self.prims = 0
        self.known: set[str] = set()
        self.images: list[str] = []
        self.left_out: list[str] = []

    def leave(self, what: str) -> None:
        """Notes what of the scene no rig can hold, once."""
        if what not in self.left_out:
            self.left_out.append(what)

    def open_all(self) -> None:
        """Opens all, so that nothing outside is looked for when they are composed."""
        from pxr import Sdf

        pending = [str(self.root)]
        while pending:
            identifier = pending.pop()
            if identifier in self.known:
                continue
            self.known.add(identifier)
            if len(self.known) > _MAX_LAYERS:
                raise Refused(f"more than {_MAX_LAYERS} layers", "a rig in fewer")
            if not identifier.endswith("]"):  # a layer in a package is counted with it
                self._count(identifier)
            layer = Sdf.Layer.FindOrOpen(identifier)
            if layer is None:
                raise Refused(f"a layer that cannot be read, {_shown(identifier)}", "USD")
            self._count_prims(layer)
            pending += [self.inside(layer, name) for name in layer.GetCompositionAssetDependencies() if name]

    def _count_prims(self, layer: Any) -> None:
        """Refuses prims that would fill the memory: composed in little of it, OpenUSD crashes, or waits for ever."""
        pending = [layer.pseudoRoot]
        while pending:
            children = pending.pop().nameChildren
            self.prims += len(children)
            if self.prims > _MAX_PRIMS:
                raise Refused(f"more than {_MAX_PRIMS} prims", "a rig")
            pending += children

    def inside(self, layer: Any, name: str) -> str:
        """The full name of a layer or an image that a layer names; refused where it is outside."""
        from pxr import Ar, Sdf

        name = Sdf.Layer.SplitIdentifier(name)[0]
        if name.startswith("`") or "://" in name or "\0" in name:
            raise Refused(f"a reference to {_shown(name)}", "a file in the folder of the layer")
        anchor = layer.realPath or layer.identifier
        if anchor.lower().endswith((".usdz", "]")):  # a package's own layers name what is in it
            package, inner = Ar.SplitPackageRelativePathOuter(anchor)
            inner = inner or _first_of_package(package)
            target = posixpath.normpath(posixpath.join(posixpath.dirname(inner), name))
            if target.startswith(("/", "..")):
                raise Refused(f"a reference to {_shown(name)}", "a file in the package")
            return str(Ar.JoinPackageRelativePath([package, target]))
        file = os.path.realpath(os.path.join(os.path.dirname(anchor), name))
        if os.path.commonpath([file, self.folder]) != self.folder:
            raise Refused(f"a reference to {_shown(name)}, outside its folder", "files in its folder or below")
        if not os.path.isfile(file):
            raise Refused(f"a reference to {_shown(name)}, which is not there", "an existing file")
        return file

    def check(self, stage: Any) -> None:
        """Checks that the stage is composed of these layers alone and without errors."""
        for layer in stage.GetUsedLayers():
            own = layer.anonymous or layer.identifier in self.known or layer.realPath in self.known
            if not own and os.path.realpath(layer.realPath) not in self.known:
                raise Refused(f"the layer {_shown(layer.identifier)}, outside its folder", "layers in its folder")
        errors = stage.GetCompositionErrors()
        if errors:
            raise Refused(_shown(str(errors[0]), 200), "a scene that can be composed")

    def _count(self, file: str) -> None:
        size = os.path.getsize(file)
        if Path(file).suffix.lower() not in ENDINGS:
            raise Refused(f"a reference to {_shown(file)}", "a layer ending in " + ", ".join(ENDINGS))
        self.size += size
        if self.size > _LARGEST_FILE:
            raise Refused(f"layers of {self.size} bytes", f"at most {_LARGEST_FILE}")
        self.limit(self.size)


def _first_of_package(package: str) -> str:
    from pxr import Sdf

    names = Sdf.ZipFile.Open(package).GetFileNames()
    return str(names[0]) if names else ""


def _mesh_prims(stage: Any) -> Iterator[Any]:
    """What the scene shows of meshes."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for count, prim in enumerate(prims):
        if count == _MAX_PRIMS:
            raise Refused(f"more than {_MAX_PRIMS} prims", "a rig")
        if prim.HasMetadata("clips"):
            raise Refused(f"value clips at {_shown(prim.GetPath())}", "an animation in the file itself: flatten it")
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
        if not prim.IsA(UsdGeom.Mesh):
            continue
        looks = UsdGeom.Imageable(prim)
        hidden = looks.ComputeVisibility(Usd.TimeCode.EarliestTime()) == UsdGeom.Tokens.invisible
        if not hidden and looks.ComputePurpose() not in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
            yield prim


class _MeshReader:
    """One mesh prim: its arrays, and the record of what they mean."""

    def __init__(self, stage: Any, prim: Any, layers: _Layers) -> None:
        from pxr import UsdGeom, UsdSkel

        self.stage, self.prim, self.layers = stage, prim, layers
        self.mesh, self.binding = UsdGeom.Mesh(prim), UsdSkel.BindingAPI(prim)
        self.place = _shown(prim.GetPath())
        self.arrays: dict[str, Any] = {}

    def read(self, transforms: Any) -> dict[str, Any] | None:
        """The record; none where the mesh has no face."""
        from pxr import UsdGeom

        points = self._still(self.mesh.GetPointsAttr(), "points")
        counts = self._still(self.mesh.GetFaceVertexCountsAttr(), "faces (an animated topology)")
        corners = self._still(self.mesh.GetFaceVertexIndicesAttr(), "faces (an animated topology)")
        if points is None or counts is None or corners is None or not len(counts):
            return None
        points, counts, corners = _rows(points, 3), np.array(counts, np.int64), np.array(corners, np.int64)
        if counts.min() < 3 or int(counts.sum()) != len(corners):
            found = f"{len(corners)} corners for faces of {int(counts.min())} to {int(counts.max())} corners"
            raise Refused(f"{self.place}: {found}", f"faces of at least 3, {int(counts.sum())} corners in all")
        if corners.min() < 0 or corners.max() >= len(points):
            found = f"corners that name the points {corners.min()} to {corners.max()}"
            raise Refused(f"{self.place}: {found}", f"points 0 to {len(points) - 1}")
        matrix = self._matrix(transforms)
        order = np.arange(len(corners))
        left = self.mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        if left != bool(np.linalg.det(matrix[:3, :3]) < 0):
            order = _reversed(counts)
        look = self._look()
        self._coordinates(look[1], len(points), corners)
        self._colors(len(points))
        kept, held = self._without_holes(counts)
        order = order[held]
        self.arrays |= {"points": points, "counts": counts[kept], "corners": corners[order]}
        if "uv_corners" in self.arrays:
            self.arrays["uv_corners"] = self.arrays["uv_corners"][order]
        if look[0] is not None:
            self.arrays["texture"] = np.frombuffer(look[0], np.uint8)
        notes = self.prim.GetCustomDataByKey(_NOTES)
        return {
            "name": str(self.prim.GetName()),
            "place": self.place,
            "path": str(self.prim.GetPath()),
            "matrix": matrix.ravel().tolist(),
            "notes": notes if isinstance(notes, str) else None,
            "shapes": self._shapes(),
        }

    def animation(self) -> Any:
        """The ``SkelAnimation`` prim that moves the mesh's shapes; none where nothing does."""
        from pxr import UsdSkel

        skeleton = self._skeleton()
        bound = [self.binding] if skeleton is None else [UsdSkel.BindingAPI(skeleton), self.binding]
        sources = [one.GetInheritedAnimationSource() for one in bound]
        sources += [self._named(one.GetAnimationSourceRel()) for one in bound]
        return next((source for source in sources if source and source.IsA(UsdSkel.Animation)), None)

    def _skeleton(self) -> Any:
        """The prim of the skeleton that the mesh is bound to; none where it is not."""
        found = self.binding.GetInheritedSkeleton()
        return found.GetPrim() if found else self._named(self.binding.GetSkeletonRel())

    def _named(self, relationship: Any) -> Any:
        """The prim that a relationship names: before USD 23.8 files applied no schema, without which none inherits."""
        targets = relationship.GetForwardedTargets() if relationship else []
        prim = self.stage.GetPrimAtPath(targets[0]) if targets else None
        return prim if prim else None

    def _still(self, attribute: Any, what: str) -> Any:
        """The value of an attribute that must not change over time."""
        from pxr import Usd

        value = attribute.Get(Usd.TimeCode.EarliestTime())
        times = attribute.GetTimeSamples()
        for time in times[1:]:  # one sample at a time is in memory
            if attribute.Get(time) != value:
                raise Refused(
                    f"{self.place}: {what} that change over {len(times)} samples",
                    "a mesh that stands still, with blend shapes for what moves",
                )
        return value

    def _matrix(self, transforms: Any) -> Any:
        """From points to the scene, (4,4), for rows; a skinned mesh stands where its skeleton's rest pose puts it."""
        from pxr import UsdSkel

        matrix = transforms.GetLocalToWorldTransform(self.prim)
        skeleton = self._skeleton()
        joints = self.binding.GetJointIndicesPrimvar()
        skinned = skeleton is not None and joints and joints.HasAuthoredValue()
        if skinned and len(UsdSkel.Skeleton(skeleton).GetJointsAttr().Get() or ()):
            bind = self.binding.GetGeomBindTransformAttr().Get()
            matrix = transforms.GetLocalToWorldTransform(skeleton)
            matrix = matrix if bind is None else bind * matrix
        found = np.array(matrix, np.float64)
        if not np.isfinite(found).all():
            raise Refused(f"{self.place}: a transform that is NaN or overflows", "finite numbers")
        return found

    def _without_holes(self, counts: Any) -> tuple[Any, Any]:
        """Which faces are no holes, and which corners are theirs."""
        holes = np.array(self.mesh.GetHoleIndicesAttr().Get() or (), np.int64)
        kept = np.ones(len(counts), bool)
        kept[holes[(holes >= 0) & (holes < len(counts))]] = False
        if not kept.any():
            raise Refused(f"{self.place}: holes only", "faces")
        return kept, np.repeat(kept, counts)

    def _coordinates(self, wanted: str | None, points: int, corners: Any) -> None:
        from pxr import UsdGeom

        primvars = UsdGeom.PrimvarsAPI(self.prim)
        names = [wanted] if wanted else list(_UV_NAMES)
        names += [
            one.GetPrimvarName() for one in primvars.GetPrimvars() if one.GetTypeName().role == "TextureCoordinate"
        ]
        for name in names:
            primvar = primvars.FindPrimvarWithInheritance(name)
            value = primvar.Get() if primvar and primvar.HasValue() else None
            if value is None or not hasattr(value, "__len__") or not len(value) or not hasattr(value[0], "__len__"):
                continue
            rows = _rows(value, len(value[0]))[:, :2]
            indices = np.array(primvar.GetIndices(), np.int64) if primvar.IsIndexed() else np.arange(len(rows))
            kind = primvar.GetInterpolation()
            expected = {"faceVarying": len(corners), "vertex": points, "varying": points}.get(str(kind))
            if rows.shape[1] != 2 or expected is None:
                continue
            if len(indices) != expected or (len(indices) and not 0 <= indices.min() <= indices.max() < len(rows)):
                raise Refused(
                    f"{self.place}: {len(indices)} texture coordinates ({name}, {kind})",
                    f"{expected}, each within the {len(rows)} that there are",
                )
            of_corner = indices if str(kind) == "faceVarying" else indices[corners]
            self.arrays |= {"uvs": rows, "uv_corners": of_corner}
            return

    def _colors(self, points: int) -> None:
        primvar = self.mesh.GetDisplayColorPrimvar()
        value = primvar.ComputeFlattened() if primvar and primvar.HasValue() else None
        if value is not None and str(primvar.GetInterpolation()) in ("vertex", "varying") and len(value) == points:
            self.arrays["colors"] = _rows(value, 3)

    def _look(self) -> tuple[bytes | None, str | None]:
        """The image of most faces, encoded, and the name of the coordinates that it is laid out in."""
        from pxr import UsdShade

        subsets = UsdShade.MaterialBindingAPI(self.prim).GetMaterialBindSubsets()
        parts = [(len(subset.GetIndicesAttr().Get() or ()), subset.GetPrim()) for subset in subsets]
        parts.sort(key=lambda part: -part[0])
        found: tuple[bytes | None, str | None] = None, None
        for _, prim in [*parts, (0, self.prim)]:
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
            if material and material.GetPrim().GetCustomDataByKey(_PAINTED):
                continue
            surface = material.ComputeSurfaceSource()[0] if material else None
            texture = _source(surface, "diffuseColor")
            if texture is None or texture.GetIdAttr().Get() != "UsdUVTexture":
                continue
            coordinates = _source(texture, "st")
            named = coordinates is not None and coordinates.GetIdAttr().Get() == _COORDINATES
            primvar = _value(coordinates, "varname") if named else None
            image = self._image(texture, read=found[0] is None)
            if image is not None:
                found = image, str(primvar) if primvar else None
        return found

    def maps(self) -> tuple[list[str], dict[str, Any]]:
        """The shapes that have detail maps, and the images, encoded, by their numbers and ``neutral``."""
        from pxr import Sdf, UsdShade

        listed = self._noted_maps()
        subsets = UsdShade.MaterialBindingAPI(self.prim).GetMaterialBindSubsets()
        for prim in [*(subset.GetPrim() for subset in subsets), self.prim]:
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
            surface = material.ComputeSurfaceSource()[0] if material else None
            named = {"neutral": _source(surface, "normal")}
            for number, (_, name) in enumerate(listed):
                if surface and Sdf.Path.IsValidIdentifier(name):
                    named[f"{number}"] = UsdShade.Shader.Get(self.stage, material.GetPath().AppendChild(name))
            images = {key: self._image(texture, read=True) for key, texture in named.items() if texture}
            found = {key: np.frombuffer(image, np.uint8) for key, image in images.items() if image is not None}
            if found:
                missing = [name for number, (_, name) in enumerate(listed) if f"{number}" not in found]
                if missing:
                    raise Refused(f"{self.place}: no texture {_shown(missing[0])}", "one for each detail map noted")
                return [shape for shape, _ in listed], found
        return [], {}

    def _noted_maps(self) -> list[tuple[str, str]]:
        """Shapes and names of textures that torchface noted."""
        notes = self.prim.GetCustomDataByKey(_NOTES)
        try:
            listed = json.loads(notes)[_WRINKLE_MAPS] if isinstance(notes, str) else []
            found = [(one["shape"], one["texture"]) for one in listed]
        except (ValueError, TypeError, KeyError, RecursionError):
            return []
        return found if all(isinstance(name, str) for one in found for name in one) else []

    def _image(self, texture: Any, read: bool) -> bytes | None:
        """The image of a texture, encoded; none where there is none, or it is not to be read."""
        from pxr import Ar

        found = texture.GetInput("file")
        attributes = found.GetValueProducingAttributes() if found else []
        value = attributes[0].Get() if attributes else None
        name = getattr(value, "path", "")
        if not name:
            return None
        if "<UDIM>" in name:
            self.layers.leave(f"the tiled texture (UDIM) {_shown(name)}, expected one image")
            return None
        stack = attributes[0].GetPropertyStack()
        file = self.layers.inside(stack[0].layer, name)
        if file not in self.layers.images:
            self.layers.images.append(file)
        if not read:
            return None
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(file))
        if not asset:
            raise Refused(f"an image that cannot be read, {_shown(name)}", "an existing file")
        if asset.GetSize() > _LARGEST_FILE // 8:
            raise Refused(f"an image of {asset.GetSize()} bytes, {_shown(name)}", f"at most {_LARGEST_FILE // 8}")
        with asset:
            return bytes(asset.GetBuffer())

    def _shapes(self) -> list[dict[str, Any]]:
        from pxr import UsdSkel

        targets = self.binding.GetBlendShapeTargetsRel().GetForwardedTargets()
        tokens = self.binding.GetBlendShapesAttr().Get()
        names = [str(token) for token in tokens] if tokens else [target.name for target in targets]
        if len(names) != len(targets) or len(set(names)) != len(names):
            found = f"{len(names)} names of blend shapes, {len(set(names))} of them different"
            raise Refused(f"{self.place}: {found}", f"one for each of {len(targets)} targets")
        records = []
        for number, target in enumerate(targets):
            shape = UsdSkel.BlendShape(self.stage.GetPrimAtPath(target))
            if not shape:
                raise Refused(f"{self.place}: the target {_shown(target)}", "a BlendShape")
            rows = shape.GetPointIndicesAttr().Get()
            self.arrays[f"shape/{number}/offsets"] = _rows(shape.GetOffsetsAttr().Get() or (), 3)
            if rows is not None and len(rows):
                self.arrays[f"shape/{number}/rows"] = np.array(rows, np.int64)
            steps: list[dict[str, Any]] = []
            for between in shape.GetInbetweens():
                weight, offsets = between.GetWeight(), between.GetOffsets()
                if weight is None or offsets is None:
                    continue
                self.arrays[f"shape/{number}/between/{len(steps)}"] = _rows(offsets, 3)
                steps.append({"name": str(between.GetAttr().GetName()).partition(":")[2], "weight": float(weight)})
            records.append({"name": names[number], "between": steps})
        return records


def _weights(stage: Any, prims: list[Any], arrays: dict[str, Any]) -> dict[str, Any] | None:
    """What animations give shapes; of several with one name the first's weights count."""
    from pxr import UsdSkel

    found: dict[str, tuple[Any, int]] = {}
    times: set[float] = set()
    for prim in prims:
        animation = UsdSkel.Animation(prim)
        attribute = animation.GetBlendShapeWeightsAttr()
        if attribute.GetNumTimeSamples() < 1:
            continue
        names = [str(name) for name in animation.GetBlendShapesAttr().Get() or ()]
        times |= set(attribute.GetTimeSamples())
        for column, name in enumerate(names):
            found.setdefault(name, (attribute, column))
    if not found:
        return None
    ordered = sorted(times)
    values = np.zeros((len(ordered), len(found)), np.float32)
    for attribute in dict.fromkeys(attribute for attribute, _ in found.values()):
        mine = [(place, column) for place, (own, column) in enumerate(found.values()) if own == attribute]
        places, columns = (list(side) for side in zip(*mine, strict=True))
        for row, time in enumerate(ordered):  # USD gives one sample at a time, between two the linear blend
            weights = np.array(attribute.Get(time), np.float32)
            if len(weights) <= max(columns):
                raise Refused(f"{len(weights)} weights at time code {time:g}", f"one for each of {len(mine)} shapes")
            values[row, places] = weights[columns]
    arrays |= {"animation/times": np.array(ordered) / stage.GetTimeCodesPerSecond(), "animation/weights": values}
    return {"names": list(found)}


def _source(shader: Any, name: str) -> Any:
    """The shader that an input is connected to; none where it is not."""
    from pxr import UsdShade

    found = shader.GetInput(name) if shader else None
    attributes = found.GetValueProducingAttributes() if found else []
    return (
        UsdShade.Shader(attributes[0].GetPrim())
        if attributes and attributes[0].GetPrim().IsA(UsdShade.Shader)
        else None
    )


def _value(shader: Any, name: str) -> Any:
    found = shader.GetInput(name)
    attributes = found.GetValueProducingAttributes() if found else []
    return attributes[0].Get() if attributes else None


def _rows(value: Any, width: int) -> Any:
    return np.array(value, np.float32).reshape(-1, width)


def _reversed(counts: Any) -> Any:
    """Places of all corners with each face's turned round, its first corner kept."""
    start = np.repeat(np.cumsum(counts) - counts, counts)
    size = np.repeat(counts, counts)
    place = np.arange(len(start)) - start
    return start + (size - place) % size


def _said(error: Exception) -> str:
    """What OpenUSD's error says, without the names in its own code."""
    try:
        text = str(error)
    except UnicodeDecodeError:
        return "text that is no UTF-8"
    found = re.findall(r" : '(.*)'", text)
    return re.sub(r"(parse error) matching pxrInternal.*", r"\1", found[0]) if found else text


def _shown(text: object, longest: int = 80) -> str:
    found = str(text).replace("\n", " ")
    return found if len(found) <= longest else found[: longest - 3] + "..."


def limit_growth(start: int, size: int) -> None:
    """Ends this process's growth at so much memory, time and output as files of ``size`` bytes may take.

    Args:
        start: bytes of addresses before the first was opened.
        size: bytes.
    """
    if sys.platform == "win32":  # no such limits there
        return
    import resource

    limits = {
        resource.RLIMIT_AS: start + max(_MEMORY_ALWAYS, _MEMORY_A_BYTE * size),
        resource.RLIMIT_FSIZE: max(_OUTPUT_ALWAYS, _OUTPUT_A_BYTE * size),
        resource.RLIMIT_CPU: int(_SECONDS_ALWAYS + _SECONDS_A_MEGABYTE * size / 2**20),
    }
    for kind, limit in limits.items():
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))


def _addresses() -> int:
    """Bytes of addresses in use; those that the imports take are no file's fault."""
    status = Path("/proc/self/statm")
    if sys.platform == "win32" or not status.exists():
        return 2**40
    return int(status.read_text().split()[0]) * os.sysconf("SC_PAGESIZE")


def end_in_time(seconds: int) -> None:
    """Has the system end this process after so long, and at once when the one that started it is gone: what waits for a
    lock in C++ notices neither."""
    if sys.platform == "win32":
        return
    import signal

    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(seconds)
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL))


def main(path: Path, folder: Path, what: Callable[..., tuple[dict[str, Any], dict[str, Any]]]) -> None:
    """Reads ``path`` and writes what came of it into ``folder``."""
    end_in_time(int(_WALL_ALWAYS + _WALL_A_MEGABYTE * path.stat().st_size / 2**20))
    from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel  # noqa: F401  all of them before the limits hold

    start = _addresses()
    try:
        scene, arrays = what(path, lambda size: limit_growth(start, size))
    except Refused as refused:
        (folder / "refused.json").write_text(json.dumps([refused.found, refused.expected]))
        return
    except MemoryError:
        (folder / "refused.json").write_text(json.dumps(["what fills the memory", "a rig of its file's size"]))
        return
    np.savez(folder / "arrays.npz", **arrays)
    (folder / "scene.json").write_text(json.dumps(scene))


if __name__ == "__main__":
    main(Path(sys.argv[-2]), Path(sys.argv[-1]), extract_maps if "--maps" in sys.argv[1:-2] else extract)

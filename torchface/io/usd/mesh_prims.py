"""A mesh of a USD stage: its faces, colours, image, shapes and detail maps, as arrays; see ``stage_process``."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from pxr import Ar, Sdf, Usd, UsdGeom, UsdShade, UsdSkel

from torchface.io.usd.stage_layers import LARGEST_FILE, MAX_PRIMS, Layers, Refused, shown

_NOTES, _PAINTED, _WRINKLE_MAPS = "torchface", "torchface_painted", "wrinkleMaps"
_UV_NAMES = ("st", "UVMap", "st0", "map1", "uv", "uvs")
_COORDINATES = "UsdPrimvarReader_float2"


def mesh_prims(stage: Any) -> Iterator[Any]:
    """What the scene shows of meshes."""
    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for count, prim in enumerate(prims):
        if count == MAX_PRIMS:
            raise Refused(f"more than {MAX_PRIMS} prims", "a rig")
        if prim.HasMetadata("clips"):
            raise Refused(f"value clips at {shown(prim.GetPath())}", "an animation in the file itself: flatten it")
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
        if not prim.IsA(UsdGeom.Mesh):
            continue
        looks = UsdGeom.Imageable(prim)
        hidden = looks.ComputeVisibility(Usd.TimeCode.EarliestTime()) == UsdGeom.Tokens.invisible
        if not hidden and looks.ComputePurpose() not in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
            yield prim


class MeshReader:
    """One mesh prim: its arrays, and the record of what they mean."""

    def __init__(self, stage: Any, prim: Any, layers: Layers) -> None:
        self.stage, self.prim, self.layers = stage, prim, layers
        self.mesh, self.binding = UsdGeom.Mesh(prim), UsdSkel.BindingAPI(prim)
        self.place = shown(prim.GetPath())
        self.arrays: dict[str, Any] = {}

    def read(self, transforms: Any) -> dict[str, Any] | None:
        """The record; none where the mesh has no face."""
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
        looks, covered, named = self._looks(len(counts))
        self._coordinates(named, len(points), corners)
        self._colors(len(points))
        kept, held = self._without_holes(counts)
        order = order[held]
        self.arrays |= {"points": points, "counts": counts[kept], "corners": corners[order], "looks": covered[kept]}
        if "uv_corners" in self.arrays:
            self.arrays["uv_corners"] = self.arrays["uv_corners"][order]
        notes = self.prim.GetCustomDataByKey(_NOTES)
        return {
            "name": str(self.prim.GetName()),
            "place": self.place,
            "path": str(self.prim.GetPath()),
            "matrix": matrix.ravel().tolist(),
            "notes": notes if isinstance(notes, str) else None,
            "shapes": self._shapes(),
            "looks": looks,
        }

    def animation(self) -> Any:
        """The ``SkelAnimation`` prim that moves the mesh's shapes; none where nothing does."""
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

    def _looks(self, faces: int) -> tuple[list[dict[str, Any]], Any, str | None]:
        """What covers the faces, which of that each has, (P,), and in which coordinates the image of most is laid out.

        A look is the number of an ``image`` or none, and a ``color`` in light, or none for what torchface painted.
        """
        looks, of = [], np.zeros(faces, np.int64)
        subsets = UsdShade.MaterialBindingAPI(self.prim).GetMaterialBindSubsets()
        for number, prim in enumerate([self.prim, *(subset.GetPrim() for subset in subsets)]):
            looks.append(self._look(prim))
            if number:
                rows = np.array(subsets[number - 1].GetIndicesAttr().Get() or (), np.int64)
                of[rows[(rows >= 0) & (rows < faces)]] = number
        count = np.bincount(of, minlength=len(looks))
        shown_most = max(range(len(looks)), key=lambda one: (looks[one][0]["image"] is not None, count[one]))
        return [look for look, _ in looks], of, looks[shown_most][1]

    def _look(self, prim: Any) -> tuple[dict[str, Any], str | None]:
        """What a prim's material shows, and the name of the coordinates of its image."""
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        if material and material.GetPrim().GetCustomDataByKey(_PAINTED):
            return {"image": None, "color": None}, None
        surface = material.ComputeSurfaceSource()[0] if material else None
        texture = _source(surface, "diffuseColor")
        if texture is None or texture.GetIdAttr().Get() != "UsdUVTexture":
            color = np.array(_value(surface, "diffuseColor") if surface else None, object)
            plain = color.shape == (3,) and np.isfinite(color.astype(np.float64)).all()
            return {"image": None, "color": [float(value) for value in color] if plain else None}, None
        coordinates = _source(texture, "st")
        named = coordinates is not None and coordinates.GetIdAttr().Get() == _COORDINATES
        primvar = _value(coordinates, "varname") if named else None
        return {"image": self._image_number(texture), "color": None}, str(primvar) if primvar else None

    def maps(self) -> tuple[list[str], dict[str, Any]]:
        """The shapes that have detail maps, and the images, encoded, by their numbers and ``neutral``."""
        listed = self._noted_maps()
        subsets = UsdShade.MaterialBindingAPI(self.prim).GetMaterialBindSubsets()
        for prim in [*(subset.GetPrim() for subset in subsets), self.prim]:
            material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
            surface = material.ComputeSurfaceSource()[0] if material else None
            named = {"neutral": _source(surface, "normal")}
            for number, (_, name) in enumerate(listed):
                if surface and Sdf.Path.IsValidIdentifier(name):
                    named[f"{number}"] = UsdShade.Shader.Get(self.stage, material.GetPath().AppendChild(name))
            files = {key: self._image(texture) for key, texture in named.items() if texture}
            found = {key: self.layers.images[file] for key, file in files.items() if file is not None}
            if found:
                missing = [name for number, (_, name) in enumerate(listed) if f"{number}" not in found]
                if missing:
                    raise Refused(f"{self.place}: no texture {shown(missing[0])}", "one for each detail map noted")
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

    def _image_number(self, texture: Any) -> int | None:
        """The place of a texture's image among those of the scene; none where there is none."""
        found = self._image(texture)
        return None if found is None else list(self.layers.images).index(found)

    def _image(self, texture: Any) -> str | None:
        """The file of a texture's image, encoded among those of the scene; none where there is none."""
        found = texture.GetInput("file")
        attributes = found.GetValueProducingAttributes() if found else []
        value = attributes[0].Get() if attributes else None
        name = getattr(value, "path", "")
        if not name:
            return None
        if "<UDIM>" in name:
            self.layers.leave(f"the tiled texture (UDIM) {shown(name)}, expected one image")
            return None
        stack = attributes[0].GetPropertyStack()
        file = self.layers.inside(stack[0].layer, name)
        if file in self.layers.images:
            return file
        asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(file))
        if not asset:
            raise Refused(f"an image that cannot be read, {shown(name)}", "an existing file")
        total = asset.GetSize() + sum(len(image) for image in self.layers.images.values())
        if total > LARGEST_FILE // 8:
            raise Refused(f"images of {total} bytes up to {shown(name)}", f"at most {LARGEST_FILE // 8}")
        with asset:
            self.layers.images[file] = np.frombuffer(bytes(asset.GetBuffer()), np.uint8)
        return file

    def _shapes(self) -> list[dict[str, Any]]:
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
                raise Refused(f"{self.place}: the target {shown(target)}", "a BlendShape")
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


def _source(shader: Any, name: str) -> Any:
    """The shader that an input is connected to; none where it is not."""
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

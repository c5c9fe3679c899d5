"""A process that adds blend shapes to meshes of a USD file and writes it; it stands alone, with OpenUSD beside it.

``python shapes_in_stage.py IN FOLDER OUT``: the folder holds ``shapes.json``, a list of ``path``, ``names`` and
``notes`` (landmarks and regions as JSON, or none) of each mesh, and ``shapes.npz``, of mesh i and shape j
``i/j/rows`` and ``i/j/offsets``, in the mesh's own points.
"""

import json
import os
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np


def add_shapes(layer: Any, meshes: list[dict[str, Any]], arrays: Any) -> None:
    """Blend shapes under each mesh's prim, behind those that it has; all else of the layer stays."""
    from pxr import Tf, Usd, UsdSkel, Vt

    stage = Usd.Stage.Open(layer)
    for number, record in enumerate(meshes):
        prim = stage.GetPrimAtPath(record["path"])
        if not prim or prim.IsInstanceProxy():
            raise SystemExit(f"{record['path']} is an instance, in which nothing can be written: make it editable")
        if record["notes"] is not None and prim.GetCustomDataByKey("torchface") is None:
            prim.SetCustomDataByKey("torchface", record["notes"])
        if not record["names"]:
            continue
        binding = UsdSkel.BindingAPI.Apply(prim)
        names = list(binding.GetBlendShapesAttr().Get() or [])
        targets = list(binding.GetBlendShapeTargetsRel().GetTargets())
        for row, name in enumerate(record["names"]):
            path = prim.GetPath().AppendChild(Tf.MakeValidIdentifier(name))
            shape = UsdSkel.BlendShape.Define(stage, path)
            offsets = np.ascontiguousarray(arrays[f"{number}/{row}/offsets"], np.float32)
            shape.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(offsets))
            shape.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(arrays[f"{number}/{row}/rows"].astype(np.int32)))
            names.append(name)
            targets.append(path)
        binding.CreateBlendShapesAttr(names)
        binding.CreateBlendShapeTargetsRel().SetTargets(targets)


def main(path: Path, folder: Path, out: Path) -> None:
    """Writes ``out``, of the same kind as ``path``."""
    from pxr import Sdf, UsdUtils

    meshes, arrays = json.loads((folder / "shapes.json").read_text()), np.load(folder / "shapes.npz")
    with tempfile.TemporaryDirectory(dir=folder) as unpacked:
        root = path
        if path.suffix.lower() == ".usdz":
            with zipfile.ZipFile(path) as package:
                package.extractall(unpacked)
                root = Path(unpacked, package.namelist()[0])
        layer = Sdf.Layer.FindOrOpen(str(root))
        add_shapes(layer, meshes, arrays)
        if root is not path:
            layer.Save()
            if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(root)), str(out)):
                raise SystemExit("the package cannot be written")
            return
        written = Sdf.Layer.CreateAnonymous(root.suffix)
        written.TransferContent(layer)

        def moved(asset: str) -> str:
            here = os.path.join(root.parent, asset)
            return os.path.relpath(here, out.parent) if asset and os.path.exists(here) else asset

        if out.parent != root.parent:
            UsdUtils.ModifyAssetPaths(written, moved)
        written.Export(str(out))


if __name__ == "__main__":
    main(*(Path(argument).resolve() for argument in sys.argv[1:4]))

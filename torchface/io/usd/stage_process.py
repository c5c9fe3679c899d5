"""The process that reads a USD file: run by its path, with OpenUSD and NumPy alone, never imported by the library.

``python stage_process.py FILE FOLDER`` writes ``scene.json`` and ``arrays.npz`` (see
``torchface.io.scene_processes.scene_arrays``) into the folder, or ``refused.json``, a list of what was found and what
was expected; with ``--maps`` before FILE those of its detail maps (see ``extract_maps``), with ``--points COUNT`` those
of a point cache (see ``extract_points``). OpenUSD is C++ that trusts
its files: here a crash, a count of gigabytes or an endless composition ends a process that has nothing to lose.
"""

import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdSkel

if __name__ == "__main__":  # the files beside this one, without the library, which takes seconds to import
    sys.modules["torchface.io.usd"] = beside = ModuleType("torchface.io.usd")
    beside.__path__ = [str(Path(__file__).resolve().parent)]
from torchface.io.usd.mesh_prims import MeshReader, mesh_prims
from torchface.io.usd.process_limits import addresses_in_use, end_in_time, limit_growth
from torchface.io.usd.stage_layers import Layers, Refused, shown

_WALL_ALWAYS, _WALL_A_MEGABYTE = 120, 10
_MAX_MESHES = 4096


def extract(path: Path, limit: Callable[[int], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A USD scene as what JSON can hold, and arrays by name; see ``torchface.io.scene_processes.scene_arrays``.

    ``limit`` is called with the bytes of all files so far, before the next is opened.
    """
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
        for prim in mesh_prims(stage):
            number = len(scene["meshes"])
            if number == _MAX_MESHES:
                raise Refused(f"more than {_MAX_MESHES} meshes", "a rig")
            reader = MeshReader(stage, prim, layers)
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
        arrays |= {f"image/{number}": image for number, image in enumerate(layers.images.values())}
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
        for number, prim in enumerate(mesh_prims(stage)):
            if found[1] or number == _MAX_MESHES:
                break
            found = MeshReader(stage, prim, layers).maps()
        return {"shapes": found[0], "bytes": layers.size, "left_out": layers.left_out}, found[1]


def extract_points(path: Path, limit: Callable[[int], None], count: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """A point cache: the ``times``, seconds, and ``points`` (T,V,3) of the first prim of ``count`` points that move.

    Arguments and errors as of :func:`extract`. The prim may be a mesh or, as in caches without topology, an ``over``.
    """
    with _refusals():
        layers, stage = _opened(path, limit)
        sizes = []
        for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.PrimAllPrimsPredicate):
            attribute = prim.GetAttribute("points")
            times = attribute.GetTimeSamples() if attribute else []
            if prim.HasMetadata("clips"):
                raise Refused(f"value clips at {shown(prim.GetPath())}", "a cache in the file itself: flatten it")
            if len(times) < 2:
                continue
            sizes.append(len(attribute.Get(times[0]) or ()))
            if sizes[-1] != count:
                continue
            points = np.empty((len(times), count, 3), np.float32)
            for row, time in enumerate(times):  # USD gives one sample at a time
                frame = np.array(attribute.Get(time), np.float32)
                if frame.shape != (count, 3):
                    raise Refused(f"{len(frame)} points at time code {time:g} of {shown(prim.GetPath())}", f"{count}")
                points[row] = frame
            transform = UsdGeom.XformCache(Usd.TimeCode(times[0])).GetLocalToWorldTransform(prim)
            scene: dict[str, Any] = {
                "metres_per_unit": float(UsdGeom.GetStageMetersPerUnit(stage)),
                "up": str(UsdGeom.GetStageUpAxis(stage)),
                "bytes": layers.size,
                "left_out": layers.left_out,
                "meshes": [{"name": shown(prim.GetName()), "place": shown(prim.GetPath())}],
            }
            scene["meshes"][0]["matrix"] = np.array(transform).ravel().tolist()
            return scene, {"times": np.array(times) / stage.GetTimeCodesPerSecond(), "points": points}
        if sizes:
            raise Refused(f"prims of {sizes[:5]} points that move", f"one of {count}, as the head has")
        return {"bytes": layers.size, "left_out": layers.left_out, "meshes": []}, {}


def _opened(path: Path, limit: Callable[[int], None]) -> tuple[Layers, Any]:
    layers = Layers(path, limit)
    layers.open_all()
    stage = Usd.Stage.Open(Sdf.Layer.FindOrOpen(str(path)), Usd.Stage.LoadAll)
    layers.check(stage)
    return layers, stage


@contextmanager
def _refusals() -> Iterator[None]:
    """Refuses what OpenUSD raises."""
    try:
        yield
    except Tf.ErrorException as error:
        raise Refused(shown(_said(error), 300), "a whole USD file") from error
    except (RuntimeError, ValueError, TypeError) as error:  # prims that are gone, text that is no UTF-8, other types
        raise Refused(f"what OpenUSD does not give as it should ({shown(error, 200)})", "a whole USD file") from error


def _weights(stage: Any, prims: list[Any], arrays: dict[str, Any]) -> dict[str, Any] | None:
    """What animations give shapes; of several with one name the first's weights count."""
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


def _said(error: Exception) -> str:
    """What OpenUSD's error says, without the names in its own code."""
    try:
        text = str(error)
    except UnicodeDecodeError:
        return "text that is no UTF-8"
    found = re.findall(r" : '(.*)'", text)
    return re.sub(r"(parse error) matching pxrInternal.*", r"\1", found[0]) if found else text


def main(path: Path, folder: Path, what: Callable[..., tuple[dict[str, Any], dict[str, Any]]]) -> None:
    """Reads ``path`` and writes what came of it into ``folder``."""
    end_in_time(int(_WALL_ALWAYS + _WALL_A_MEGABYTE * path.stat().st_size / 2**20))
    start = addresses_in_use()
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
    kind, *given = sys.argv[1:-2] or ["--scene"]
    what: Callable[..., tuple[dict[str, Any], dict[str, Any]]] = extract_maps if kind == "--maps" else extract
    main(
        Path(sys.argv[-2]),
        Path(sys.argv[-1]),
        partial(extract_points, count=int(given[0])) if kind == "--points" else what,
    )

"""The files that a USD stage is composed of: counted, and in one folder or package; see ``stage_process``."""

import os
import posixpath
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pxr import Ar, Sdf

ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
MAX_PRIMS, LARGEST_FILE = 200_000, 2**31
_MAX_LAYERS = 256


class Refused(Exception):
    """The file cannot be read: what was found, and what was expected."""

    def __init__(self, found: str, expected: str) -> None:
        super().__init__(found, expected)
        self.found, self.expected = found, expected


class Layers:
    """A root layer and the layers that it is composed of, each opened once, in the root's folder or package."""

    def __init__(self, root: Path, limit: Callable[[int], None]) -> None:
        self.root, self.folder, self.limit = root, os.path.realpath(root.parent), limit
        self.size = self.prims = 0
        self.known: set[str] = set()
        self.images: dict[str, Any] = {}  # encoded, by file
        self.left_out: list[str] = []

    def leave(self, what: str) -> None:
        """Notes what of the scene no rig can hold, once."""
        if what not in self.left_out:
            self.left_out.append(what)

    def open_all(self) -> None:
        """Opens all, so that nothing outside is looked for when they are composed."""
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
                raise Refused(f"a layer that cannot be read, {shown(identifier)}", "USD")
            self._count_prims(layer)
            pending += [self.inside(layer, name) for name in layer.GetCompositionAssetDependencies() if name]

    def _count_prims(self, layer: Any) -> None:
        """Refuses prims that would fill the memory: composed in little of it, OpenUSD crashes, or waits for ever."""
        pending = [layer.pseudoRoot]
        while pending:
            children = pending.pop().nameChildren
            self.prims += len(children)
            if self.prims > MAX_PRIMS:
                raise Refused(f"more than {MAX_PRIMS} prims", "a rig")
            pending += children

    def inside(self, layer: Any, name: str) -> str:
        """The full name of a layer or an image that a layer names; refused where it is outside."""
        name = Sdf.Layer.SplitIdentifier(name)[0]
        if name.startswith("`") or "://" in name or "\0" in name:
            raise Refused(f"a reference to {shown(name)}", "a file in the folder of the layer")
        anchor = layer.realPath or layer.identifier
        if anchor.lower().endswith((".usdz", "]")):  # a package's own layers name what is in it
            package, inner = Ar.SplitPackageRelativePathOuter(anchor)
            inner = inner or _first_of_package(package)
            target = posixpath.normpath(posixpath.join(posixpath.dirname(inner), name))
            if target.startswith(("/", "..")):
                raise Refused(f"a reference to {shown(name)}", "a file in the package")
            return str(Ar.JoinPackageRelativePath([package, target]))
        file = os.path.realpath(os.path.join(os.path.dirname(anchor), name))
        if os.path.commonpath([file, self.folder]) != self.folder:
            raise Refused(f"a reference to {shown(name)}, outside its folder", "files in its folder or below")
        if not os.path.isfile(file):
            raise Refused(f"a reference to {shown(name)}, which is not there", "an existing file")
        return file

    def check(self, stage: Any) -> None:
        """Checks that the stage is composed of these layers alone and without errors."""
        for layer in stage.GetUsedLayers():
            own = layer.anonymous or layer.identifier in self.known or layer.realPath in self.known
            if not own and os.path.realpath(layer.realPath) not in self.known:
                raise Refused(f"the layer {shown(layer.identifier)}, outside its folder", "layers in its folder")
        errors = stage.GetCompositionErrors()
        if errors:
            raise Refused(shown(str(errors[0]), 200), "a scene that can be composed")

    def _count(self, file: str) -> None:
        size = os.path.getsize(file)
        if Path(file).suffix.lower() not in ENDINGS:
            raise Refused(f"a reference to {shown(file)}", "a layer ending in " + ", ".join(ENDINGS))
        self.size += size
        if self.size > LARGEST_FILE:
            raise Refused(f"layers of {self.size} bytes", f"at most {LARGEST_FILE}")
        self.limit(self.size)


def _first_of_package(package: str) -> str:
    names = Sdf.ZipFile.Open(package).GetFileNames()
    return str(names[0]) if names else ""


def shown(text: object, longest: int = 80) -> str:
    found = str(text).replace("\n", " ")
    return found if len(found) <= longest else found[: longest - 3] + "..."

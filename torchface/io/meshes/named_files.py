"""The files that a mesh's file names: material libraries, textures, buffers."""

import re
from itertools import islice
from pathlib import Path
from urllib.parse import unquote

from torchface.errors import FileFormatError
from torchface.files.whole_files import read_file

_MAX_NAMES = 1000  # in one file
_URI = re.compile(rb'"uri"\s*:\s*"((?!data:)[^"\\]{1,1024})"')
# What begins with a word is found fast, and a name too many does no harm.
_NAMES = {
    ".obj": re.compile(rb"mtllib[ \t]+([^\r\n]{1,1024})"),
    ".mtl": re.compile(rb"map_Kd[ \t]+([^\r\n]{1,1024})"),
    ".gltf": _URI,
    ".glb": _URI,
}


def named_files(mesh: str | Path) -> list[Path]:
    """The existing files, in the mesh's folder or below, that it and its material libraries name; none where it cannot
    be read."""
    files: dict[Path, None] = {}
    waiting = [Path(mesh)]
    while waiting:
        file = waiting.pop()
        pattern = _NAMES.get(file.suffix.lower())
        if pattern is None:
            continue
        try:
            names = dict.fromkeys(islice((match[1] for match in pattern.finditer(read_file(file))), _MAX_NAMES))
        except FileFormatError:
            continue
        for name in names:
            for other in _beside(file, name.decode("utf-8", "replace").strip()):
                if other not in files:
                    files[other] = None
                    waiting.append(other)
    return list(files)


def _beside(file: Path, name: str) -> list[Path]:
    """What a name may mean: as it stands, percent-decoded, or its last word after options."""
    folder = file.resolve().parent
    files = []
    for text in dict.fromkeys((name, unquote(name), name.split()[-1] if name.split() else "")):
        try:
            path = (folder / text.replace("\\", "/")).resolve()
            if path.is_relative_to(folder) and path.is_file():
                files.append(path)
        except (OSError, ValueError):
            continue
    return files

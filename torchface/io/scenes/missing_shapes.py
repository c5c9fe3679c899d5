"""What is said of a scene without shapes."""

from pathlib import Path
from shlex import quote

from torchface.errors import NoShapesError


def no_shapes(path: str | Path, found: str) -> NoShapesError:
    """The error of a file that has been found without shapes, with the commands that give it some."""
    name = quote(str(path))
    return NoShapesError(
        f"{path}: found {found}, expected at least one for a rig; torchface rig {name} --out NEW.glb gives a character "
        f"ARKit's shapes, torchface arkit {name} --out NEW.glb a head mesh"
    )


def no_target(meshes: int) -> str:
    """What has been found in so many meshes of a glTF file."""
    return f"no morph target in its {meshes} meshes" if meshes != 1 else "no morph target in its one mesh"

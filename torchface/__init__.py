"""torchface: learn face rigs from scans, solve performances with them, ship them as ONNX and glTF.

Names load on first use, so that ``import torchface`` is quick and a command needs only what it touches.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# Threads of small matrix products that spin while they wait cost a busy machine ten times the work itself. Torch reads
# it once: a program that imports torch first sets it for itself.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "1.0.0"

_HOMES = {
    "Mesh": "torchface.mesh",
    "Annotations": "torchface.mesh",
    "Track": "torchface.take",
    "Take": "torchface.take",
    "BlendshapeRig": "torchface.rig",
    "Corrective": "torchface.correctives",
    "Correctives": "torchface.correctives",
    "Attachment": "torchface.attachment",
    "TorchfaceError": "torchface.errors",
    "load_mesh": "torchface.io",
    "save_mesh": "torchface.io",
    "load_rig": "torchface.io",
    "save_rig": "torchface.io",
    "save_animation": "torchface.io",
    "load_take": "torchface.io",
    "save_take": "torchface.io",
}

_PACKAGES = ("capture", "enhancement", "io", "landmarks", "modeling", "optim", "registration", "zoo")

__all__ = [  # in letters, not computed: checkers of types read it
    "Annotations",
    "Attachment",
    "BlendshapeRig",
    "Corrective",
    "Correctives",
    "Mesh",
    "Take",
    "TorchfaceError",
    "Track",
    "__version__",
    "load_mesh",
    "load_rig",
    "load_take",
    "save_animation",
    "save_mesh",
    "save_rig",
    "save_take",
]

if TYPE_CHECKING:
    from torchface import capture, enhancement, io, landmarks, modeling, optim, registration, zoo
    from torchface.attachment import Attachment
    from torchface.correctives.corrective_shapes import Corrective, Correctives
    from torchface.errors import TorchfaceError
    from torchface.io import load_mesh, load_rig, load_take, save_animation, save_mesh, save_rig, save_take
    from torchface.mesh import Annotations, Mesh
    from torchface.rig import BlendshapeRig
    from torchface.take import Take, Track


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return import_module(f"torchface.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'torchface' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, *_PACKAGES])

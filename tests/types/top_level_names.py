"""What checkers of types see at the top of torchface; `make lint` checks this file, and nothing runs it."""

from typing import assert_type

import torchface
from torchface import BlendshapeRig, Mesh, Take, load_mesh, load_rig, load_take

assert_type(load_rig("actor.glb"), BlendshapeRig)
assert_type(load_mesh("actor.obj"), Mesh)
assert_type(load_take("take.c3d"), Take)
assert_type(torchface.zoo.list_models(), list[str])

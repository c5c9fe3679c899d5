"""Files that Blender reads and writes for us, FBX and its own, in a process of its own."""

from torchface.io.blender.blender_files import (
    BLENDER_ENDINGS,
    BlenderScene,
    blender_program,
    read_blender_file,
    write_blender_file,
)

__all__ = ["BLENDER_ENDINGS", "BlenderScene", "blender_program", "read_blender_file", "write_blender_file"]

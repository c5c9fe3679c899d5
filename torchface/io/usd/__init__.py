"""USD with UsdSkel's blend shapes, read from whoever wrote it and written for whoever reads it."""

from torchface.io.usd.usd_library import require_usd
from torchface.io.usd.usd_reading import read_usd_detail, read_usd_mesh, read_usd_rig, read_usd_weights
from torchface.io.usd.usd_writing import USD_ENDINGS, write_usd_mesh, write_usd_rig

__all__ = [
    "USD_ENDINGS",
    "read_usd_detail",
    "read_usd_mesh",
    "read_usd_rig",
    "read_usd_weights",
    "require_usd",
    "write_usd_mesh",
    "write_usd_rig",
]

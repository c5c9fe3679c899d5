"""OpenUSD's own library, which is an extra: asked for in one place."""

import importlib
import importlib.util
import sys
from types import SimpleNamespace
from typing import Any

from torchface.errors import MissingExtraError

_MODULES = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdShade", "UsdSkel", "UsdUtils", "Vt")


def require_usd() -> None:
    """Checks that usd-core is installed."""
    if importlib.util.find_spec("pxr") is None:
        raise MissingExtraError(
            "USD: usd-core is not installed, expected it for .usd, .usda, .usdc and .usdz; "
            f"{sys.executable} -m pip install usd-core"
        )


def usd_library() -> Any:
    """The modules of ``pxr`` as attributes."""
    require_usd()
    return SimpleNamespace(**{name: importlib.import_module(f"pxr.{name}") for name in _MODULES})

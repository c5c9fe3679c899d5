"""scikit-learn, which training alone needs."""

from __future__ import annotations

import importlib
from types import ModuleType

from torchface.errors import MissingExtraError


def scikit(module: str) -> ModuleType:
    """A module of scikit-learn, such as ``svm``.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return importlib.import_module(f"sklearn.{module}")
    except ImportError as error:
        raise MissingExtraError(
            "training a classifier needs scikit-learn: pip install 'torchface[train]' (a trained one runs without)"
        ) from error

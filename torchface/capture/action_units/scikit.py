"""scikit-learn, which training alone needs."""

from __future__ import annotations

from types import ModuleType

from torchface.files.extra_packages import import_extra


def scikit(module: str) -> ModuleType:
    """A module of scikit-learn, such as ``svm``.

    Raises:
        MissingExtraError: it is not installed.
    """
    return import_extra(f"sklearn.{module}", "scikit-learn", "train", "training a classifier")

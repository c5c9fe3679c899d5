"""Packages that only some jobs need, imported where they are."""

from __future__ import annotations

import importlib
from typing import Any

from torchface.errors import MissingExtraError


def import_extra(module: str, package: str, extra: str, job: str) -> Any:
    """A module of a package that torchface installs only with an extra.

    Args:
        module: what to import, such as ``sklearn.svm``.
        package: what users know it as, such as ``scikit-learn``.
        extra: of torchface, that installs it.
        job: what needs it, for the message.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{job} needs {package}, which is not installed ({error}); expected: pip install torchface[{extra}]"
        ) from error

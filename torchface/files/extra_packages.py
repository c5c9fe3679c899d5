"""Packages that only some jobs need, imported where they are."""

import importlib
import re
import sys
from importlib.metadata import PackageNotFoundError, requires
from typing import Any

from torchface.errors import MissingExtraError


def import_extra(module: str, package: str, extra: str, job: str) -> Any:
    """A ``module`` of a ``package`` that torchface installs only with an extra; ``job`` is what needs it, for the
    message."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingExtraError(
            f"{job} needs {package}, which is not installed ({error}); this installs it: "
            f"{sys.executable} -m pip install '{_requirement(package, extra)}'"
        ) from error


def _requirement(package: str, extra: str) -> str:
    """The package with the versions that the extra asks for: what pip takes in a checkout and beside a wheel."""
    try:
        lines = requires("torchface") or []
    except PackageNotFoundError:  # run from a folder that was never installed
        lines = []
    for line in lines:
        requirement, _, marker = line.partition(";")
        if re.search(rf"extra == .{re.escape(extra)}\W*$", marker) and re.match(
            rf"{re.escape(package)}\b", requirement
        ):
            return requirement.replace(" ", "")
    return package

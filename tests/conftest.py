"""Where tests find real data, and how hypothesis behaves."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

REPOSITORY = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("TORCHFACE_DATA", REPOSITORY.parent / "shared" / "data"))

settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True)
settings.register_profile("dev", deadline=None)
settings.load_profile("ci" if os.environ.get("CI") else "dev")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if DATA.is_dir():
        return
    skip = pytest.mark.skip(reason=f"real data not found at {DATA}; set TORCHFACE_DATA to run this test")
    for item in items:
        if item.get_closest_marker("real"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real data; mark the test ``real`` to have it skipped where there is none."""
    return DATA


@pytest.fixture(scope="session")
def ict_folder(data: Path) -> Path:
    """ICT-FaceKit's FaceXModel folder as its users download it."""
    return data / "ict_facekit" / "FaceXModel"


@pytest.fixture(scope="session")
def performances(data: Path) -> list[Path]:
    """Real Live Link Face takes."""
    return sorted((data / "performances").glob("*.csv"))

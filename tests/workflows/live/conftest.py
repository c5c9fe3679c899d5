"""The character that the session's tests move."""

from pathlib import Path

import pytest

from torchface import BlendshapeRig, save_rig


@pytest.fixture(scope="module")
def dome(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small character by ARKit's names."""
    path = tmp_path_factory.mktemp("character") / "dome.glb"
    save_rig(dome_rig, path)
    return path

"""What the page turns of a character beside its shapes: arms that hang, eyes in the head."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited_characters import edited, sheet
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.browser
Run = Callable[[str, object], Any]


def test_arms_that_stand_off_hang_and_arms_that_hang_stay(run: Run, tmp_path: Path) -> None:
    def with_arms(root: dict[str, Any]) -> None:
        first = len(root["nodes"])
        root["nodes"] += [
            {"name": "LeftArm", "translation": [0.1, 0.0, 0.0], "children": [first + 1]},
            {"name": "LeftForeArm", "translation": [0.3, 0.0, 0.0]},
            {"name": "RightArm", "translation": [-0.1, 0.0, 0.0], "children": [first + 3]},
            {"name": "RightForeArm", "translation": [-0.05, -0.3, 0.0]},
        ]
        root["skins"] = [{"joints": [*range(first, first + 4)]}]
        root["scenes"][0]["nodes"] += [first, first + 2]

    told = run("pose", edited(sheet(tmp_path / "a.glb", ("jawOpen",)).read_bytes(), tmp_path / "arms.glb", with_arms))
    left, right = (
        np.subtract(told["places"][f"{side}ForeArm"], told["places"][f"{side}Arm"]) for side in ("Left", "Right")
    )
    neck = Rotation.from_euler("Y", 0.3)  # the whole character turns, as it has no head
    left, right = (neck.inv().apply(way) for way in (left, right))
    assert left[1] / 0.3 < -0.95
    assert left[0] > 0
    np.testing.assert_allclose(right, [-0.05, -0.3, 0], atol=1e-6)


def test_eyes_that_no_shape_moves_turn_in_the_head(run: Run, tmp_path: Path) -> None:
    data = sheet(tmp_path / "sheet.glb", ("jawOpen",)).read_bytes()

    def with_eye(root: dict[str, Any]) -> None:
        root["nodes"][0]["children"] = [1]
        root["nodes"].append({"name": "LeftEye", "translation": [0.01, 0.02, 0.03]})

    way = run("pose", edited(data, tmp_path / "eye.glb", with_eye))["ways"]["LeftEye"]
    x, y, z = np.sin(0.2) * np.cos(0.1), np.sin(0.1), np.cos(0.2) * np.cos(0.1)  # 0.2 to the person's left, 0.1 up
    expected = [np.cos(0.3) * x + np.sin(0.3) * z, y, np.cos(0.3) * z - np.sin(0.3) * x]
    np.testing.assert_allclose(way, expected, atol=1e-6)

"""The README's Python runs when it is pasted, in an empty folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from torchface.io import load_animation

README = Path(__file__).resolve().parents[2] / "README.md"


def test_the_first_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(code, str(README), "exec"), names)
    smiles = names["solved"].weights.select(["mouthSmileLeft"]).values[:, 0, 0]
    assert abs(float(smiles[-1]) - 1) < 0.05
    take = load_animation(tmp_path / "smile.glb")
    assert take is not None
    assert len(take) == 60

"""Weights in percent and rotations in degrees are recognised on planted takes, and on no real one."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import Take, Track, load_take, save_take
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.shape_names import ARKIT


def planted(names: tuple[str, ...]) -> Take:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(100, len(names), 1, generator=generator)
    angles = 0.6 * torch.randn(100, len(ROTATIONS), dtype=torch.float64, generator=generator).clamp(-1.5, 1.5)
    columns = {name: angles[:, i] for i, name in enumerate(ROTATIONS)}
    return Take(60.0, weights=Track(names, weights), extras={"columns": columns})


@pytest.mark.parametrize("names", [ARKIT, ("one", "two")], ids=["Live Link", "plain"])
def test_percent_and_degrees_are_converted_and_said(names: tuple[str, ...], tmp_path: Path) -> None:
    take = planted(names)
    assert take.weights is not None
    columns = {name: column * 180 / math.pi for name, column in take.extras["columns"].items()}
    percent = Track(names, 100 * take.weights.values)
    save_take(replace(take, weights=percent, extras={"columns": columns}), tmp_path / "take.csv")
    with pytest.warns(UserWarning, match="taken for") as said:
        found = load_take(tmp_path / "take.csv")
    texts = [str(one.message) for one in said]
    assert any("found weights up to 9" in text and "taken for percent" in text for text in texts)
    assert any("rotations up to 51.57, expected radians; they are taken for degrees" in text for text in texts)
    assert found.weights is not None
    torch.testing.assert_close(found.weights.values, take.weights.values)
    for name in ROTATIONS:
        torch.testing.assert_close(found.extras["columns"][name], take.extras["columns"][name])


def test_usual_units_and_single_wild_frames_stay(tmp_path: Path) -> None:
    take = planted(("one", "two"))
    assert take.weights is not None
    values = take.weights.values.clone().repeat(3, 1, 1)
    values[7] = 80.0
    columns = {name: column.repeat(3) for name, column in take.extras["columns"].items()}
    columns["HeadYaw"][3] = 50.0
    save_take(Take(60.0, weights=Track(("one", "two"), values), extras={"columns": columns}), tmp_path / "take.csv")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = load_take(tmp_path / "take.csv")
    assert found.weights is not None
    assert found.weights.values.equal(values)
    assert found.extras["columns"]["HeadYaw"].equal(columns["HeadYaw"])


@pytest.mark.real
def test_real_takes_are_in_usual_units(performances: list[Path]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in performances:
            load_take(path)

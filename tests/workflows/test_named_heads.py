"""The head model that is taken where nobody names one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchface import zoo
from torchface.modeling import HeadModel, MorphableModel
from torchface.synthetic import performer
from torchface.workflows.named_heads import NamedHeads
from train.morphable import Settings


def test_people_go_before_performers_and_models_with_a_rig_before_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(zoo.HOME, str(tmp_path))
    before = NamedHeads.of(None)
    assert before.name == "head"
    assert "torchface train morphable --ict FaceXModel" in before.line
    template = performer(texture=False).select(["jawOpen"])
    shape = MorphableModel(
        template.vertices, torch.eye(1)[:, :, None].expand(1, len(template.vertices), 3), torch.ones(1)
    )
    card = zoo.ModelCard("MIT", "3 people.", {"shape components": 1.0}, "none")
    zoo.save_model(HeadModel.on(template.neutral, shape), tmp_path / "bare", card)
    assert NamedHeads.of(None).name == "bare"
    zoo.save_model(HeadModel.on(template.neutral, shape, rig=template), tmp_path / "people", card)
    made_up = zoo.ModelCard("MIT", "performers", {"shape components": 9.0}, "none", settings={"performers": 9})
    zoo.save_model(HeadModel.on(template.neutral, shape, rig=template), tmp_path / "more", made_up)
    chosen = NamedHeads.of(None)
    assert chosen.name == "people"
    assert chosen.line == "head model: people, 3 people; another with --model"
    assert NamedHeads.of("head") == NamedHeads("head")


def test_heads_of_ict_are_put_where_they_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(zoo.HOME, str(tmp_path))
    assert Settings(ict=tmp_path / "FaceXModel").out == tmp_path / "people"
    assert Settings(ict=tmp_path / "FaceXModel", out=Path("a")).out == Path("a")
    assert Settings(performers=3).out == Path("models/head")

"""Two performers on the camera stage: one to learn from, one to try on."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from torchface.capture.action_units import GROUPS, ActionUnitClassifier, RegionVideo, read_regions
from torchface.capture.action_units.classifier import group_regions
from torchface.synthetic import draw_identities
from train.filmed_performers.action_performance import PerformanceSettings
from train.filmed_performers.camera_stage import RecordedSession, StageSettings, record_session
from train.filmed_performers.helmet_camera import CameraFlaws

SIZE = 40


@pytest.fixture(scope="session")
def stage_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("camera_stage")


@pytest.fixture(scope="session")
def session(stage_folder: Path) -> RecordedSession:
    """Two repetitions of each unit, one of a combination, 20 frames a second."""
    performance = PerformanceSettings(2, 1, (("4", "9"),), fps=20.0, pace=1.3)
    flaws = CameraFlaws(shake_rotation=0.6, shake_translation=1.2)
    settings = StageSettings(128, 170, markers=20, flaws=flaws, performance=performance)
    return record_session(stage_folder, "first", None, torch.Generator().manual_seed(3), settings)


@pytest.fixture(scope="session")
def other(stage_folder: Path) -> RecordedSession:
    """Another face, each unit once."""
    performance = PerformanceSettings(1, 1, (("4", "9"),), fps=20.0, pace=1.3)
    settings = StageSettings(128, 170, markers=20, performance=performance)
    identity = draw_identities(3, torch.Generator().manual_seed(5), scale=0.7)[1]
    return record_session(stage_folder, "second", identity, torch.Generator().manual_seed(2), settings)


@pytest.fixture(scope="session")
def regions(session: RecordedSession) -> RegionVideo:
    return read_regions(session.video, session.labels, group_regions(GROUPS), size=SIZE)


@pytest.fixture(scope="session")
def classifier(regions: RegionVideo, session: RecordedSession) -> ActionUnitClassifier:
    return ActionUnitClassifier.fit([regions], [session.labels])

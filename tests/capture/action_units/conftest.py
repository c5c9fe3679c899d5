"""Two performers on the camera stage: one to learn from, one to try on."""

import pytest
import torch

from torchface.capture.action_units import GROUPS, ActionUnitClassifier, RegionVideo, read_regions
from torchface.capture.action_units.classifier import group_regions
from torchface.synthetic import draw_identities
from train.filmed_performers.action_performance import PerformanceSettings
from train.filmed_performers.camera_stage import RecordedSession, StageSettings, record_session

SIZE = 40


@pytest.fixture(scope="session")
def session(filmed_session: RecordedSession) -> RecordedSession:
    return filmed_session


@pytest.fixture(scope="session")
def other(tmp_path_factory: pytest.TempPathFactory) -> RecordedSession:
    """Another face, each unit once."""
    performance = PerformanceSettings(1, 1, (("4", "9"),), fps=20.0, pace=1.3)
    settings = StageSettings(128, 170, markers=20, performance=performance)
    identity = draw_identities(3, torch.Generator().manual_seed(5), scale=0.7)[1]
    folder = tmp_path_factory.mktemp("camera_stage")
    return record_session(folder, "second", identity, torch.Generator().manual_seed(2), settings)


@pytest.fixture(scope="session")
def regions(session: RecordedSession) -> RegionVideo:
    return read_regions(session.video, session.labels, group_regions(GROUPS), size=SIZE)


@pytest.fixture(scope="session")
def classifier(regions: RegionVideo, session: RecordedSession) -> ActionUnitClassifier:
    return ActionUnitClassifier.fit([regions], [session.labels])

"""A classifier from the zoo's folder becomes an ONNX file that gives the same."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.capture import ActionUnitClassifier
from torchface.capture.action_units.classifier import GroupSize
from torchface.capture.action_units.painted_regions import GROUPS, RegionGroup
from torchface.cli.export import action_units as command
from torchface.errors import NameMismatchError
from torchface.modeling import MorphableModel


@pytest.fixture
def classifier() -> ActionUnitClassifier:
    """Whose numbers are drawn at random."""
    generator = torch.Generator().manual_seed(0)
    groups: list[RegionGroup] = [GROUPS[0], GROUPS[3]]
    model = ActionUnitClassifier(groups, [GroupSize(5, 7), GroupSize(3, 2)], 24)
    for name, buffer in model.named_buffers():
        if not any(part in name for part in ("gabor", "_class", "deviations", "intensities", "mean")):
            buffer.copy_(torch.randn(buffer.shape, generator=generator))
        elif "intensities" in name:
            buffer.copy_(torch.rand(buffer.shape, generator=generator))
    model.neutral.copy_(torch.rand(model.neutral.shape, generator=generator))
    return model


@pytest.fixture
def folder(classifier: ActionUnitClassifier, tmp_path: Path) -> Path:
    zoo.save_model(classifier, tmp_path / "units", zoo.ModelCard("MIT", "made", {}, "none"))
    return tmp_path / "units"


@pytest.mark.bench
def test_the_file_gives_the_same(classifier: ActionUnitClassifier, folder: Path, tmp_path: Path) -> None:
    command(str(folder), tmp_path / "one.onnx", quiet=True)
    frames = torch.rand(40, 3, 24, 24, generator=torch.Generator().manual_seed(1))
    session = onnxruntime.InferenceSession(tmp_path / "one.onnx")
    (found,) = session.run(None, {"regions": frames.numpy(), "rest": classifier.neutral.numpy()})
    assert np.abs(found - classifier(frames, classifier.neutral).numpy()).max() < 1e-6
    broken = with_gaps(frames[:3])
    (gaps,) = session.run(None, {"regions": broken.numpy(), "rest": classifier.neutral.numpy()})
    np.testing.assert_allclose(gaps, classifier(broken, classifier.neutral).numpy(), atol=1e-6)
    assert len(np.unique(found, axis=0)) > 3


def with_gaps(frames: Tensor) -> Tensor:
    """A region of the first of three frames holds a NaN, one of the second an infinity."""
    broken = frames.clone()
    broken[0, 0, 3, 3], broken[1, -1, 5, 5] = torch.nan, torch.inf
    return broken


def test_what_is_seen_in_no_number_is_none(classifier: ActionUnitClassifier) -> None:
    """In the module, under a transform, which makes no check of numbers, and where the face at rest holds it."""
    frames = torch.rand(3, 3, 24, 24, generator=torch.Generator().manual_seed(1))
    whole, found = (classifier(given, classifier.neutral) for given in (frames, with_gaps(frames)))
    first = len(classifier.groups[0].units)
    expected = whole.clone()
    expected[0, :first], expected[1, first:] = torch.nan, torch.nan
    torch.testing.assert_close(found, expected, equal_nan=True)
    mapped = torch.func.vmap(lambda frame: classifier(frame[None], classifier.neutral)[0])(with_gaps(frames))
    torch.testing.assert_close(mapped, expected, equal_nan=True)
    assert classifier(frames, with_gaps(classifier.neutral[None].expand(3, -1, -1, -1))[1])[:, first:].isnan().all()


def test_another_model_is_refused(tmp_path: Path) -> None:
    heads = MorphableModel.fit(torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0)))
    zoo.save_model(heads, tmp_path / "heads", zoo.ModelCard("MIT", "made", {}, "none"))
    with pytest.raises(NameMismatchError, match="a MorphableModel"):
        command(str(tmp_path / "heads"), tmp_path / "x.onnx", quiet=True)

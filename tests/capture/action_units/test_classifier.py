"""Planted action units come back: on the performer learned from, on another, from disk and from ONNX."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from torchface import zoo
from torchface.capture import ActionUnitClassifier, CurveSettings, action_unit_curves
from torchface.capture.action_units import (
    GROUPS,
    RegionGroup,
    RegionVideo,
    TrainingSettings,
    classify,
    load_shape_table,
    read_regions,
)
from torchface.capture.action_units.classifier_training import intensity_levels, label_group
from torchface.capture.action_units.gabor import GaborBank
from torchface.capture.action_units.one_vs_one_svm import OneVsOne
from torchface.capture.action_units.painted_regions import performed_groups
from torchface.capture.action_units.weight_targets import smooth_intensities
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.action_labels import ActionLabels
from torchface.onnx import action_unit_graph, export_action_units
from train.classifier_evaluation import cross_validation, level_agreement
from train.filmed_performers.action_performance import MOVES
from train.filmed_performers.camera_stage import RecordedSession


def planted(session: RecordedSession, units: tuple[str, ...]) -> torch.Tensor:
    performance = session.performance
    return performance.intensities[:, [performance.units.index(unit) for unit in units]]


def test_gabor_filters_tell_directions_and_ignore_even_light() -> None:
    bank = GaborBank(wavelengths=(6.0, 12.0), stride=4)
    step = torch.arange(48.0)
    y, x = torch.meshgrid(step, step, indexing="ij")
    flat = bank(torch.full((1, 48, 48), 0.7))
    assert flat.max() < 1e-3
    for k in range(4):
        angle = torch.tensor(torch.pi * k / 4)
        for scale, length in enumerate((6.0, 12.0)):
            wave = 0.5 + 0.5 * torch.cos(2 * torch.pi * (x * angle.cos() + y * angle.sin()) / length)
            response = bank(wave[None])[0, :, 3:-3, 3:-3].mean((1, 2))
            assert int(response.argmax()) == 4 * scale + k
    shifted = bank(torch.roll(wave, 1, 1)[None])[0, -1, 3:-3, 3:-3]
    assert (shifted / bank(wave[None])[0, -1, 3:-3, 3:-3] - 1).abs().max() < 0.1  # magnitudes do not see the phase


@pytest.mark.parametrize("classes", [2, 3, 6])
def test_votes_agree_with_scikit_learn(classes: int) -> None:
    svm = pytest.importorskip("sklearn.svm")
    generator = torch.Generator().manual_seed(classes)
    truth = torch.randint(0, classes, (300,), generator=generator)
    features = torch.randn(classes, 5, generator=generator)[truth] + 0.9 * torch.randn(300, 5, generator=generator)
    machine = OneVsOne(classes, 5).fit(features, truth, penalty=2.0)
    peer = svm.SVC(kernel="linear", C=2.0, break_ties=classes > 2).fit(features.double().numpy(), truth.numpy())
    probe = 2 * torch.randn(2000, 5, generator=generator)
    agreed = machine(probe).argmax(1).numpy() == peer.predict(probe.double().numpy())
    assert agreed.mean() > 0.999
    with pytest.raises(ValueRangeError, match="expected every one"):
        OneVsOne(classes + 1, 5).fit(features, truth)


def test_levels_follow_the_intensity_of_a_moving_stroke() -> None:
    pytest.importorskip("sklearn")
    phase = torch.linspace(0, torch.pi, 60).sin() ** 2
    rows = torch.arange(24.0)
    stroke = torch.exp(-(((rows[None, :] - 6 - 9 * phase[:, None]) / 2.5) ** 2))
    images = stroke[:, None, :, None].expand(-1, 1, -1, 8) + 0.02 * torch.randn(
        60, 1, 24, 8, generator=torch.Generator().manual_seed(0)
    )
    at_rest = torch.zeros(60, dtype=torch.bool)
    at_rest[[0, 1, -2, -1]] = True
    levels = intensity_levels(images, at_rest)
    assert levels.unique().tolist() == [0, 1, 2, 3]
    assert (levels[at_rest] == 0).all()
    assert torch.corrcoef(torch.stack([levels.float(), phase]))[0, 1] > 0.95
    assert (levels[:30].diff() >= 0).float().mean() > 0.95
    with pytest.raises(ShapeError, match="at_rest"):
        intensity_levels(images, torch.zeros(60, dtype=torch.bool))
    with pytest.raises(ValueRangeError, match="different frames"):
        intensity_levels(torch.zeros(60, 1, 4, 4), at_rest)


def test_learned_labels_are_the_planted_intensities(regions: RegionVideo, session: RecordedSession) -> None:
    for group in GROUPS:
        rows = [regions.names.index(name) for name in group.regions]
        table, classes = label_group(regions.patterns[:, rows], [session.labels], group, TrainingSettings())
        labelled, truth = table[classes], planted(session, group.units)
        for a in range(len(group.units)):
            assert torch.corrcoef(torch.stack([labelled[:, a], truth[:, a]]))[0, 1] > 0.93, group.units[a]


def test_units_performed_once_cannot_be_left_out(regions: RegionVideo, session: RecordedSession) -> None:
    once = replace(session.labels, performed=session.labels.performed[:1])
    with pytest.raises(ValueRangeError, match="one part of repetitions to leave out, expected two"):
        cross_validation([regions], [once], performed_groups([once]), split="repetitions")


def test_planted_intensities_come_back(
    classifier: ActionUnitClassifier, regions: RegionVideo, session: RecordedSession
) -> None:
    truth = planted(session, classifier.units)
    found = level_agreement(classify(classifier, regions), truth)
    assert found["within_one"] > 0.99
    assert found["exact"] > 0.8
    names = session.rig.names
    curves = action_unit_curves(
        classifier,
        regions,
        session.labels,
        load_shape_table("arkit"),
        names,
        CurveSettings(windows=dict.fromkeys(MOVES, 7)),
    )
    assert curves.weights.shape == curves.active.shape == (len(truth), len(names))
    assert (curves.intensities - truth).square().mean().sqrt() < 0.06
    row = names.index("noseSneerLeft")
    assert (curves.weights[:, row] - session.performance.weights[:, row]).abs().mean() < 0.04
    assert not curves.active[:, names.index("jawOpen")].any()
    assert curves.weights[:, names.index("jawOpen")].abs().max() == 0
    asked = action_unit_curves(
        classifier, regions, session.labels, load_shape_table("arkit"), names, CurveSettings(units=["9"])
    )
    assert asked.active.any(0).nonzero()[:, 0].tolist() == sorted(
        names.index(f"noseSneer{s}") for s in ("Left", "Right")
    )


@dataclass
class Learned:
    """Two groups learned from two performers, from ``arguments`` of ``fit``."""

    arguments: tuple[list[RegionVideo], list[ActionLabels], list[RegionGroup], TrainingSettings]
    classifier: ActionUnitClassifier


TWO_GROUPS = [
    RegionGroup("mouth", ("mouth",), ("18L",)),
    RegionGroup("between_brows", ("between_brows",), ("9",), ("4",)),
]


def of_two_groups(labels: ActionLabels) -> ActionLabels:
    return replace(labels, performed=tuple(s for s in labels.performed if set(s.units) <= {"18L", "9", "4"}))


@pytest.fixture(scope="module")
def both(regions: RegionVideo, session: RecordedSession, other: RecordedSession) -> Learned:
    videos = [
        regions,
        read_regions(other.video, other.labels, regions.names, regions.neutral, regions.patterns.shape[-1]),
    ]
    labels = [of_two_groups(one.labels) for one in (session, other)]
    arguments = (videos, labels, TWO_GROUPS, TrainingSettings(warps=1))
    return Learned(arguments, ActionUnitClassifier.fit(*arguments))


@pytest.mark.bench
def test_two_performers_can_be_learned_from(
    both: Learned, regions: RegionVideo, session: RecordedSession, other: RecordedSession
) -> None:
    found, again = both.classifier, ActionUnitClassifier.fit(*both.arguments)
    assert all(torch.equal(a, b) for a, b in zip(found.state_dict().values(), again.state_dict().values(), strict=True))
    assert torch.equal(found.neutral, regions.neutral[[regions.names.index(name) for name in found.regions]])
    for video, truth in zip(both.arguments[0], (session, other), strict=True):
        assert level_agreement(classify(found, video), planted(truth, found.units))["within_one"] > 0.95


def test_from_disk_and_from_onnx(
    session: RecordedSession, regions: RegionVideo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video, labels = regions, of_two_groups(session.labels)
    classifier = ActionUnitClassifier.fit([video], [labels], TWO_GROUPS, TrainingSettings(warps=1))
    zoo.save_model(classifier, tmp_path / "units", zoo.ModelCard("MIT", "made", {}, "none"))
    again = zoo.get_model(tmp_path / "units")
    assert isinstance(again, ActionUnitClassifier)
    rows = [video.names.index(name) for name in classifier.regions]
    frames, rest = video.patterns[:60, rows], video.rest[rows]
    assert torch.equal(again(frames, rest), classifier(frames, rest))
    report = export_action_units(classifier, tmp_path / "units.onnx", frames)
    assert report.agreement == 1.0
    import onnxruntime

    runtime = onnxruntime.InferenceSession(tmp_path / "units.onnx")
    (found,) = runtime.run(None, {"regions": frames.numpy(), "rest": rest.numpy()})
    assert np.abs(found - classifier(frames, rest).numpy()).max() < 1e-6
    assert classifier(frames, rest).unique(dim=0).shape[0] > 1
    meta = runtime.get_modelmeta().custom_metadata_map
    assert '"18L"' in meta["units"]

    # The graph of a classifier with other intensities is not written.
    monkeypatch.setattr(action_unit_graph, "action_unit_model", lambda *_: onnx.load(tmp_path / "units.onnx"))
    again.group_classifiers()[0].intensities.add_(0.1)
    with pytest.raises(ValueRangeError, match="agrees with PyTorch in 0"):
        export_action_units(again, tmp_path / "wrong.onnx", frames)
    assert not (tmp_path / "wrong.onnx").exists()


def test_a_config_that_cannot_be_is_refused(classifier: ActionUnitClassifier) -> None:
    good = classifier.config
    assert ActionUnitClassifier.from_config(good).config == good
    for broken in (
        {},
        {"size": 40, "groups": "many"},
        {"size": 10**9, "groups": good["groups"]},
        {"size": 40, "groups": [dict(good["groups"][0], classes=1)]},
        {"size": 40, "groups": [dict(good["groups"][0], classes=4000)]},
        {"size": 40, "groups": [dict(good["groups"][0], units=3)]},
        {"size": 40, "groups": [dict(good["groups"][0], other_units=None)]},
    ):
        with pytest.raises(FileFormatError):
            ActionUnitClassifier.from_config(broken)
    with pytest.raises(NameMismatchError, match="more than one group"):
        ActionUnitClassifier.from_config({"size": 40, "groups": [good["groups"][0]] * 2})
    with pytest.raises(ShapeError, match="regions"):
        classifier(torch.zeros(2, 3, 40, 40), torch.zeros(3, 40, 40))


def test_what_is_never_performed_is_named(regions: RegionVideo, session: RecordedSession) -> None:
    labels = session.labels
    without = replace(labels, performed=tuple(s for s in labels.performed if s.units != ("9",)))
    with pytest.raises(NameMismatchError, match="9 is never performed alone"):
        ActionUnitClassifier.fit([regions], [without])
    groups = [group for group in GROUPS if group.name == "mouth"]
    with pytest.raises(NameMismatchError, match="no group of regions shows it"):
        ActionUnitClassifier.fit([regions], [labels], groups)
    with pytest.raises(NameMismatchError, match="no region chin"):
        ActionUnitClassifier.fit([regions], [labels], [RegionGroup("chin", ("chin",), ("17",))])
    with pytest.raises(ShapeError, match="labelled as"):
        ActionUnitClassifier.fit([regions], [replace(labels, frames=labels.frames + 1)])


def test_smooth_curves_keep_to_zero_and_one() -> None:
    steps = torch.zeros(100, 2)
    steps[30:60, 0] = 1.0
    curves = smooth_intensities(steps, ("1+2", "45"))
    assert curves.min() == 0
    assert curves.max() <= 1
    assert curves[:15, 0].abs().max() == 0
    assert curves[:, 1].abs().max() == 0
    assert curves[:, 0].diff().abs().max() < 0.2
    with pytest.raises(ShapeError):
        smooth_intensities(steps, ("1+2",))

"""Where a classifier's curves of a film lead the solve of its markers."""

from dataclasses import replace

import torch

from torchface.capture import ActionUnitClassifier, CurveSettings
from torchface.capture.action_units import RegionVideo, action_unit_curves, load_shape_table
from train.filmed_performers.camera_stage import RecordedSession


def test_where_the_classifier_leads(
    classifier: ActionUnitClassifier, regions: RegionVideo, session: RecordedSession
) -> None:
    names, table = session.rig.names, load_shape_table("arkit")
    source = action_unit_curves(classifier, regions, session.labels, table, names, CurveSettings(at_rest=False))
    everywhere = action_unit_curves(classifier, regions, session.labels, table, names)
    assert not source.active[(source.levels == 0).all(1)].any()
    led = source.active.any(0)
    assert bool(everywhere.active[:, led].all())
    assert not everywhere.active[:, ~led].any()
    # Blinks, which shall not lead, keep the lids for the markers.
    asked = action_unit_curves(classifier, regions, session.labels, table, names, CurveSettings(units=["6+43"]))
    level = {unit: asked.levels[:, i] > 0 for i, unit in enumerate(asked.units)}
    blinks = level["45"] & ~level["6+43"]
    assert blinks.any()
    assert torch.equal(asked.active[:, names.index("eyeBlinkLeft")], ~blinks)
    assert bool(asked.active[:, names.index("cheekSquintLeft")].all())


def test_frames_that_hide_the_paint_are_left_to_the_markers(
    classifier: ActionUnitClassifier, regions: RegionVideo, session: RecordedSession
) -> None:
    """A hand before the brows for half a second, while nothing else is hidden."""
    names, table = session.rig.names, load_shape_table("arkit")
    hidden, patterns = slice(60, 70), regions.patterns.clone()
    patterns[hidden, regions.names.index("brow_left")] = 0.0
    whole = action_unit_curves(classifier, regions, session.labels, table, names)
    found = action_unit_curves(classifier, replace(regions, patterns=patterns), session.labels, table, names)
    brow, pucker = names.index("browInnerUp"), names.index("mouthPucker")
    assert whole.seen.all()
    assert whole.active[hidden, brow].any()
    assert not found.active[hidden, brow].any()
    assert torch.equal(found.active[:, pucker], whole.active[:, pucker])
    beside = found.levels[[hidden.start - 1, hidden.stop], found.units.index("1+2")]
    assert found.levels[hidden, found.units.index("1+2")].amax() <= beside.amax()

"""A classifier's curves lead the solve where markers are blind: from video and markers to weights."""

import pytest
import torch

from torchface.capture import ActionUnitClassifier, CurveSettings, HybridSolver, MarkerSolver
from torchface.capture.action_units import RegionVideo, action_unit_curves, load_shape_table
from torchface.capture.markers import gamma_curves, rest_residual
from torchface.synthetic.stages.marker_stage import record
from train.filmed_performers.action_performance import MOVES
from train.filmed_performers.camera_stage import RecordedSession, stage_markers

LED = ("4", "9", "6+43", "18L")


@pytest.mark.bench  # test_solve_with_video.py is the quicker one
def test_weights_that_markers_do_not_show(
    classifier: ActionUnitClassifier, regions: RegionVideo, session: RecordedSession
) -> None:
    rig, names, true = session.rig, session.rig.names, session.performance.weights
    led = sorted({names.index(shape) for unit in LED for shape in MOVES[unit]})
    spots = stage_markers(rig, 600)
    moved = spots.on(rig.neutral.faces, rig.deltas[led]).norm(dim=-1).amax(0)
    blind = [label for label, far in zip(spots.labels or (), moved.tolist(), strict=True) if far < 1.0]
    sites = spots.select(blind)
    take = record(rig, sites, true, torch.Generator().manual_seed(3), fps=session.performance.fps).take
    solver = MarkerSolver(rig, rest_residual(rig, sites, take))
    curves = action_unit_curves(classifier, regions, session.labels, load_shape_table("arkit"), names)
    markers = solver.arrange(take.markers)
    alone = solver(markers)
    hybrid = HybridSolver(solver)(markers, curves.weights, gamma_curves(curves.active, window=5))
    before, after = (alone - true).abs().mean(0), (hybrid - true).abs().mean(0)
    others = [i for i in range(len(names)) if i not in led]
    assert after[led].mean() < 0.5 * before[led].mean()
    assert after[others].mean() < 1.05 * before[others].mean()
    jerk = [float(weights.diff(n=3, dim=0).square().mean()) for weights in (alone, hybrid)]
    assert jerk[1] <= jerk[0]


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

"""Weights of terms and other settings are finite and in range, wherever they are given."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from torchface.capture import HybridSolver, MarkerSolver, ShapePrior, WholeTakeSolver
from torchface.capture.energy import ridge_term, sparsity_term
from torchface.capture.own_rig import VideoSettings
from torchface.enhancement import EnhancementSettings
from torchface.errors import ValueRangeError
from torchface.modeling import BakeSettings, ExpressionSettings, FitSettings, RiggingSchedule
from torchface.onnx import GraphSteps
from torchface.registration import DEFAULT_SCHEDULE, Level, Stage
from torchface.rig import BlendshapeRig
from torchface.synthetic.stages import place_markers

Setting = Callable[[float], Any]
LIKE = torch.zeros(2, 2)
STAGE = Stage(Level.GRAPH, 1.0, 1.0, 10.0)


def fields(made: Callable[..., Any], *names: str) -> dict[str, Setting]:
    return {f"{made.__qualname__}.{name}": lambda value, name=name: made(**{name: value}) for name in names}


def changed(whole: Any, *names: str) -> dict[str, Setting]:
    kind = type(whole).__name__
    return {f"{kind}.{name}": lambda value, name=name: replace(whole, **{name: value}) for name in names}


SETTINGS: dict[str, Setting] = {
    "sparsity_term": lambda value: sparsity_term(2, value, LIKE),
    "ridge_term": lambda value: ridge_term(2, value, LIKE),
    "ridge_term of a tensor": lambda value: ridge_term(2, torch.tensor(value, dtype=torch.float64), LIKE),
    "ShapePrior.strength": lambda value: ShapePrior([], [], [], value),
    **fields(
        VideoSettings,
        *("pixel_noise", "relative_noise", "sparsity", "ridge", "dynamics_strength", "pose_trust", "contour_slide"),
        *("tolerance", "steps"),
    ),
    **fields(FitSettings, "inner_weight", "expression_mean", "expression_ridge", "asymmetry", "identity_bound"),
    **fields(FitSettings, "contour_slide", "max_iterations", "transfers", "texture_size"),
    **fields(EnhancementSettings, "fps", "wavelength", "temporal"),
    **fields(GraphSteps, "seen", "with_gaps"),
    **fields(BakeSettings, "maximum_distance", "maximum_angle", "padding"),
    **fields(ExpressionSettings, "neutral_components", "offset_components", "ridge"),
    **fields(RiggingSchedule, "iterations", "unnamed", "kappa", "theta"),
    "RiggingSchedule.beta": lambda value: RiggingSchedule(beta=(0.5, value)),
    **changed(STAGE, "stiffness", "landmark_weight", "contact_weight", "tolerance", "iterations", "samples"),
    **changed(DEFAULT_SCHEDULE, "nodes", "sliding", "largest_angle"),
}


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e300])
@pytest.mark.parametrize("name", SETTINGS)
def test_settings_out_of_range_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueRangeError, match=r": found (nan|inf|-1|1e\+300|-1\.0), expected a (finite|whole) number"):
        SETTINGS[name](value)


@pytest.mark.parametrize("value", [math.nan, -1.0, 1e300])
def test_weights_of_marker_solvers_are_checked(dome_rig: BlendshapeRig, value: float) -> None:
    sites = place_markers(dome_rig, 12)
    solver = MarkerSolver(dome_rig, sites)
    for name in ("sparsity", "ridge"):
        with pytest.raises(ValueRangeError, match=f"{name}: found"):
            MarkerSolver(dome_rig, sites, **{name: value})
    for name in ("smoothness", "huber_threshold", "sparsity"):
        with pytest.raises(ValueRangeError, match=f"{name}: found"):
            WholeTakeSolver(solver, **{name: value})
    markers, weights = torch.zeros(1, 12, 3, dtype=torch.float64), torch.zeros(1, 4, dtype=torch.float64)
    with pytest.raises(ValueRangeError, match="gamma: found"):
        HybridSolver(solver)(markers, weights, torch.full_like(weights, value))
    for fps in (value, 0.0, 1e-9):
        with pytest.raises(ValueRangeError, match=r"fps: found .* frames a second"):
            WholeTakeSolver(solver)(markers, fps)

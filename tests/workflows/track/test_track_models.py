"""Models by name serve rigs of ARKit's shapes in any spelling; others are told."""

from pathlib import Path

import pytest
import torch

from torchface import BlendshapeRig, zoo
from torchface.capture.priors import ShapePrior
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.workflows.track.track_models import load_track_models


def test_models_that_do_not_fit_are_told(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    with pytest.raises(
        NameMismatchError, match="--landmarks: found head, a HeadModel, expected a LandmarkTrees or LandmarkNetwork"
    ):
        load_track_models(dome_rig, "head")
    with pytest.raises(NameMismatchError, match="--dynamics: found face_landmarks, a LandmarkTrees"):
        load_track_models(dome_rig, dynamics="face_landmarks")
    takes = [torch.rand(60, 3, generator=torch.Generator().manual_seed(seed)) for seed in range(2)]
    prior = ShapePrior.fit(takes, ("jawLeft", "mouthLeft", "browDownLeft"))
    zoo.save_model(prior, tmp_path / "other", zoo.ModelCard("MIT", "none", {}, "none"))
    with pytest.raises(NameMismatchError, match=r"other: .*jawLeft"):
        load_track_models(dome_rig, prior=tmp_path / "other")


def test_priors_of_arkits_names_serve_other_spellings_and_rates(dome_rig: BlendshapeRig) -> None:
    names = [f"{name.removesuffix('Left')}_L" if name.endswith("Left") else name for name in dome_rig.names]
    rig = BlendshapeRig(dome_rig.neutral, dome_rig.deltas, names)
    models = load_track_models(rig, prior="shape_prior", dynamics="dynamics_prior", fps=30.0)
    assert models.prior.names == models.dynamics.names == tuple(names)
    assert models.dynamics.fps == 30.0
    with pytest.raises(ValueRangeError, match=r"dynamics_prior: .*found 2 frames a second, expected from 7.5 to 480"):
        load_track_models(rig, dynamics="dynamics_prior", fps=2.0)

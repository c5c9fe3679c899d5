"""Models by name serve rigs of ARKit's shapes in any spelling; others are told."""

import re
from pathlib import Path

import pytest
import torch
from torch.nn.functional import interpolate

from torchface import BlendshapeRig, zoo
from torchface.capture.own_rig import VideoSettings, VideoSolver
from torchface.capture.priors import ShapePrior
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.landmarks.images.ibug_68 import MIRROR_68
from torchface.shape_names import ARKIT, mirror
from torchface.synthetic import performer
from torchface.workflows.named_priors import DEFAULT_PRIOR, load_priors
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


def test_a_face_in_a_mirror_is_read_as_the_mirror_image_of_it() -> None:
    """Else the brows of a film and of its mirror image differed by up to 0.17."""
    finder = load_track_models(performer(texture=False), fps=30.0).finder
    assert finder is not None
    blots = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(0))
    picture = (255 * interpolate(blots, scale_factor=40, mode="bilinear")[0]).to(torch.uint8)
    seen = finder(picture, torch.tensor([60.0, 40, 150, 150]))
    across = finder(picture.flip(-1), torch.tensor([319.0 - 60 - 150, 40, 150, 150]))
    mirrored = across.landmarks[list(MIRROR_68)] * torch.tensor([-1.0, 1.0]) + torch.tensor([319.0, 0.0])
    torch.testing.assert_close(seen.landmarks, mirrored, atol=0.05, rtol=0)
    torch.testing.assert_close(seen.expression, across.expression[mirror(ARKIT)], atol=1e-3, rtol=0)


def test_a_rig_named_as_in_maya_is_solved_with_the_same_prior_and_lids() -> None:
    rig = performer(texture=False)
    names = ["bs." + re.sub("(.*)(L|R)(eft|ight)$", r"\2_\1", name) for name in rig.names]
    priors, walks = [], []
    for one in (rig, BlendshapeRig(rig.neutral, rig.deltas, names)):
        priors.append(load_priors(one, DEFAULT_PRIOR, None).shapes.state_dict())
        walks.append(VideoSolver(one, None, torch.eye(3), settings=VideoSettings(motion=1.0)).walk_variance)
    ours, theirs = priors
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(value, theirs[key]) for key, value in ours.items() if isinstance(value, torch.Tensor))
    assert torch.equal(*walks)
    assert len(set(walks[0].tolist())) == 2  # lids are quick

"""Shape priors on real takes that they have not seen: likelihoods, and errors of solves, beside other densities."""

import pytest
import torch
from torch import Tensor

from planted.gaussian_density import gaussian
from torchface import Attachment, BlendshapeRig
from torchface.capture import ShapePrior
from torchface.capture.priors import ReciprocalPrior
from train.prior_trials import solve_error, synthetic_video

Capture = tuple[BlendshapeRig, Attachment, list[Tensor]]


@pytest.mark.real
def test_shape_priors(real_capture: Capture) -> None:
    rig, _, takes = real_capture
    learn, test = takes[:4], takes[4:]
    together, held_out = torch.cat(learn).double(), torch.cat(test).double()
    everything = (tuple(range(len(rig.names))),)
    forms: dict[str, ShapePrior | None] = {
        "none": None,
        "one Gaussian": ShapePrior(rig.names, everything, [gaussian(together)], 0.3),
        "the paper's 1/P": ReciprocalPrior.fit(learn, rig.names),
        "default": ShapePrior.fit(learn, rig.names),
    }
    clip = synthetic_video(rig, rig.names, test, 1.0, 40)
    assert clip is not None
    print("\nheld-out takes: log density a frame; error of weights solved from 68 landmarks, 1 pixel of noise")
    densities, errors = {}, {}
    for label, prior in forms.items():
        densities[label] = float("nan")
        if prior is not None and not isinstance(prior, ReciprocalPrior):
            densities[label] = float(prior.double().log_density(held_out).mean())
        errors[label] = solve_error(clip, prior, 1.0)
        print(f"  {label:30} {densities[label]:10.2f} {errors[label]:8.4f}")
    assert densities["default"] > 1.4 * densities["one Gaussian"]
    for label, share in (("none", 0.43), ("the paper's 1/P", 0.63)):
        assert errors["default"] <= share * errors[label]
    assert errors["default"] <= 0.97 * errors["one Gaussian"]

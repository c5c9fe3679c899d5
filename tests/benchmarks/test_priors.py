"""Priors on real takes that they have not seen: predictions beside simpler ones, deviations, likelihoods."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.gaussian_density import gaussian
from torchface import Attachment, BlendshapeRig
from torchface.capture import DynamicsPrior, ShapePrior
from torchface.capture.priors import ReciprocalPrior, windows_of
from train.prior_figures import calibration_picture, curves_picture, save_figure
from train.prior_trials import one_step, solve_error, synthetic_video

OUT = Path(__file__).resolve().parents[2] / "out" / "benchmarks"
SPLITS = ((4, 5), (0, 1), (2, 3), (0, 5), (1, 4))
Capture = tuple[BlendshapeRig, Attachment, list[Tensor]]


@pytest.mark.real
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_predictions_of_takes_left_out(real_capture: Capture, noise: float) -> None:
    rig, _, takes = real_capture
    print(f"\nnoise of windows {noise:g}; root mean square errors of the next frame's 53 weights")
    print(
        "  test takes  persistence  line    line in [0,1]  ours     within 1, 2, 3 deviations   all / changing weights"
    )
    for split in SPLITS:
        learn = [take for i, take in enumerate(takes) if i not in split]
        window = 3 if noise == 0 else 5
        prior = DynamicsPrior.fit(learn, rig.names, window, input_noise=noise)
        trial = one_step(prior, [takes[i] for i in split], noise)
        found = trial.metrics()
        ours, line = found["one-step error"], found["one-step error of extrapolation"]
        last = found["one-step error of persistence"]
        following = torch.cat([windows_of(takes[i].float(), window)[1] for i in split])
        inside = (trial.extrapolation + following).clamp(0, 1) - following
        scaled = (trial.errors / trial.deviations).abs()
        within = [float((scaled < k).double().mean()) for k in (1, 2, 3)]
        moving = [float((scaled[trial.changing] < k).double().mean()) for k in (1, 2, 3)]
        clipped = float(inside.square().mean().sqrt())
        shares = " ".join(f"{share:.3f}" for share in within) + "   " + " ".join(f"{share:.3f}" for share in moving)
        print(f"  {split}      {last:.5f}      {line:.5f} {clipped:.5f}        {ours:.5f}  {shares}")
        assert ours < last
        assert ours < line
        if split == SPLITS[0]:
            save_figure(calibration_picture(trial), OUT / f"dynamics_calibration_{noise:g}.png")
            save_figure(curves_picture(prior, takes[split[0]]), OUT / f"dynamics_curves_{noise:g}.png")


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

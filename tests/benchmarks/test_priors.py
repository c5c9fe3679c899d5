"""Priors on real takes that they have not seen: predictions beside simpler ones, variances, time, likelihoods."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from torch import Tensor

from torchface import Attachment, BlendshapeRig
from torchface.capture import DynamicsPrior, DynamicsSettings, ShapePrior
from torchface.capture.priors import GaussianMixture, ReciprocalPrior, face_halves, face_regions, windows_of
from torchface.capture.priors.dynamics_training import fitted_kernel
from torchface.capture.priors.gaussian_process import GaussianProcesses, Statistics, posterior, whitening_of
from torchface.capture.priors.motion_features import motion_basis
from torchface.onnx import export_model
from train.prior_figures import calibration_picture, curves_picture, save_figure
from train.prior_trials import one_step, solve_error, synthetic_video

OUT = Path(__file__).resolve().parents[2] / "out" / "benchmarks"
SPLITS = ((4, 5), (0, 1), (2, 3), (0, 5), (1, 4))
Capture = tuple[BlendshapeRig, Attachment, list[Tensor]]


def cpu_seconds(work: Callable[[], DynamicsPrior]) -> tuple[DynamicsPrior, float]:
    start = time.process_time()
    return work(), time.process_time() - start


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
def test_forms_of_the_dynamics(real_capture: Capture) -> None:
    rig, _, takes = real_capture
    names = rig.names
    forms = {
        "one process a region": face_regions(names),
        "one process for all": (tuple(range(len(names))),),
        "one process a shape": tuple((row,) for row in range(len(names))),
    }
    print("\nroot mean square error and negative log likelihood a weight, takes 5 and 6 of six left out")
    for label, groups in forms.items():
        # So many processes would take minutes with as many inducing points each.
        settings = DynamicsSettings(inducing=40, subset=400, iterations=15) if len(groups) > 10 else None
        prior, seconds = cpu_seconds(
            lambda groups=groups, settings=settings: DynamicsPrior.fit(  # type: ignore[misc]
                takes[:4], names, 3, groups=groups, settings=settings
            )
        )
        found = one_step(prior, takes[4:]).metrics()
        print(f"  {label:30} {found['one-step error']:.5f} {found['negative log likelihood a weight']:8.3f}"
              f"   learned in {seconds:.1f} s of one core")  # fmt: skip
    regions = DynamicsPrior.fit(takes[:4], names, 3)
    seen, trial = one_step(regions, takes[:4]), one_step(regions, takes[4:])
    constant = seen.errors.square().mean(0).clamp(min=1e-6)
    likelihood = float((0.5 * trial.errors.square() / constant + 0.5 * constant.log()).mean())
    print(f"  regions, one variance a shape  {'':7} {likelihood:8.3f}")
    assert trial.metrics()["negative log likelihood a weight"] < likelihood


@pytest.mark.real
def test_time(real_capture: Capture, tmp_path: Path) -> None:
    rig, _, takes = real_capture
    prior, seconds = cpu_seconds(lambda: DynamicsPrior.fit(takes, rig.names, 4, input_noise=0.01))
    frames = sum(map(len, takes))
    print(f"\n{frames} frames of {len(rig.names)} weights learned in {seconds:.1f} s of processor time")
    window = takes[0][None, :4]
    torch.set_num_threads(1)
    with torch.inference_mode():
        spent = milliseconds(lambda: prior(window))
    export_model(prior, tmp_path / "prior.onnx")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(tmp_path / "prior.onnx", options, providers=["CPUExecutionProvider"])
    inputs = {"windows": window.numpy()}
    graph = milliseconds(lambda: session.run(None, inputs))
    print(f"a frame, one thread: torch {spent:.3f} ms, onnxruntime {graph:.3f} ms of processor time")
    assert seconds < 300
    assert spent < 0.3
    assert graph < 0.3


def milliseconds(work: Callable[[], object], rounds: int = 300) -> float:
    """Processor time of one call, the best of five batches."""
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        for _ in range(rounds):
            work()
        best = min(best, time.process_time() - start)
    return 1000 * best / rounds


@pytest.mark.real
def test_beside_scikit_learn(real_capture: Capture) -> None:
    rig, _, takes = real_capture
    rows = list(face_regions(rig.names)[1])
    windows, following = windows_of(takes[0][:, rows].double(), 3)
    motion = torch.einsum("bjn,jo->bon", windows - windows.mean((0, 1)), motion_basis(3))
    inputs = (motion / motion.std(0)).flatten(1)
    steps = following - windows[:, -1]
    targets = steps / steps.std(0)
    order = torch.randperm(len(inputs), generator=torch.Generator().manual_seed(0))
    some, new = order[:500], order[500:]
    kernel = fitted_kernel(inputs[some], targets[some], inputs[some[:100]], torch.ones(3, len(rows)).double(), 50)
    kernels = ConstantKernel(kernel.signal, "fixed") * RBF((1 / kernel.inverse_lengths).numpy(), "fixed")
    theirs = GaussianProcessRegressor(kernels + WhiteKernel(kernel.noise, "fixed"), optimizer=None)
    theirs.fit(inputs[some].numpy(), targets[some].numpy())
    expected, deviation = theirs.predict(inputs[new].numpy(), return_std=True)
    print("\nlids of a real take, 500 frames to learn from; largest and root mean square distance from scikit-learn's")
    for count in (500, 100):
        points = inputs[some[:count]]
        whitening = whitening_of(kernel, points)
        features = kernel.between(inputs[some], points) @ whitening
        learned = posterior(
            kernel, points, whitening, Statistics(features.T @ features, features.T @ targets[some]), 1.0
        )
        mean, variance = GaussianProcesses.stacked([learned], [kernel])(inputs[new])
        away = mean.numpy() - expected
        spread = (variance[:, 0] + kernel.noise).sqrt().numpy() - deviation[:, 0]
        print(f"  {count} inducing points: mean {np.abs(away).max():.2e} {np.sqrt((away**2).mean()):.2e}, "
              f"deviation {np.abs(spread).max():.2e} {np.sqrt((spread**2).mean()):.2e}")  # fmt: skip
        if count == 500:
            assert np.sqrt((away**2).mean()) < 5e-3
            assert np.sqrt((spread**2).mean()) < 2e-3


@pytest.mark.real
def test_shape_priors(real_capture: Capture) -> None:
    rig, _, takes = real_capture
    learn, test = takes[:4], takes[4:]
    together, held_out = torch.cat(learn).double(), torch.cat(test).double()
    everything, halves = (tuple(range(len(rig.names))),), face_halves(rig.names)
    forms: dict[str, ShapePrior | None] = {
        "none": None,
        "one Gaussian": ShapePrior(rig.names, everything, [GaussianMixture.fit(together)], 0.3),
        "mixture of Gaussians a half": ShapePrior(
            rig.names, halves, [GaussianMixture.fit(together[:, list(half)], 4, floor=1e-3) for half in halves], 0.15
        ),
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
    assert densities["default"] > 1.4 * max(densities["one Gaussian"], densities["mixture of Gaussians a half"])
    for label, share in (("none", 0.43), ("the paper's 1/P", 0.63), ("mixture of Gaussians a half", 0.93)):
        assert errors["default"] <= share * errors[label]
    assert errors["default"] <= 0.97 * errors["one Gaussian"]

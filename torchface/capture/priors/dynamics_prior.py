"""The dynamics prior: Gaussian processes from the last frames to the next, as an energy for the solvers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchface.capture.energy import Quadratic, gaussian_term
from torchface.capture.priors.gaussian_process import GaussianProcesses
from torchface.capture.priors.motion_features import motion_basis, moving_parts, newest_frames
from torchface.capture.priors.motion_noise import MotionNoise
from torchface.capture.priors.name_translation import require_same_names
from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.documents import Value
from torchface.optim.full_precision import full_precision
from torchface.progress import Progress

_MAX_NUMBERS = 2**26
_MAX_WINDOW = 120


@dataclass(frozen=True)
class DynamicsSettings:
    """How a dynamics prior learns.

    Args:
        inducing: M, number of inducing points.
        subset: how many windows the kernels' hyperparameters are learned from.
        iterations: of gradient ascent on the bound of the marginal likelihood.
        correlation_time: seconds of a take that count as a single independent frame: neighbouring frames are
            correlated, and a process that counts each of them overfits the takes.
        floor: minimum of the predicted standard deviation, in weights.
        seed: draws windows and noise.

    Example:
        >>> take = torch.linspace(0, 12, 120).sin()[:, None].square()
        >>> quick = DynamicsSettings(inducing=8, subset=60, iterations=2)
        >>> DynamicsPrior.fit([take], ["jawOpen"], window=2, settings=quick).window
        2
    """

    inducing: int = 100
    subset: int = 1500
    iterations: int = 50
    correlation_time: float = 0.5
    floor: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        counts = min(self.inducing, self.subset, self.iterations)
        if counts < 1 or not 0 < self.correlation_time < math.inf or not 0 < self.floor < math.inf:
            raise ValueRangeError(f"dynamics settings: found {self}, expected positive numbers")


@dataclass(frozen=True, eq=False)
class UsualMotion:
    """How N shapes move each on its own, and the sizes that a dynamics prior's G processes work in."""

    center: Tensor  # the takes' mean, against which places count, (N,)
    coefficients: Tensor  # A, the autoregression over the window, (J,N)
    feature_scale: Tensor  # usual sizes of place, slope and curvature, (O,N)
    target_scale: Tensor  # s, (N,)
    gain: Tensor  # by what the mean of each process is multiplied, (G,)
    limits: Tensor  # smallest and largest weight, (2,)


class DynamicsPrior(nn.Module):
    r"""Mean and variance of the next frame's weights.

    .. math:: w_{n+1} = w_n + A x + s \, f_g(x) + \varepsilon(x), \qquad f_g \sim GP(0, k_g)

    for a window x of the last J frames. A is an autoregression of each shape on its own (diagonal in the shapes, and
    a window at rest stays at rest); the processes, one for each group of shapes, add what depends on the other shapes
    of the group and on the pose; the noise variance grows with the motion in the window. The mean stays within the
    range of weights.

    ``prior(windows)`` gives mean and variance; :meth:`energy` the quadratic for a solver.

    Args:
        names: N shapes; solvers refuse others.
        window: J, frames.
        groups: rows of ``names``, one tuple a process; every shape in one group.
        processes: of the G groups, over place, slope and curvature of all shapes.
        noise: of the next frame.
        motion: the autoregression, and what the processes' inputs and outputs are measured in.
        fps: frames a second of the takes.
        input_noise: standard deviation of the weights in the windows that it has learned from; 0 for true ones.

    Raises:
        ShapeError: the parts do not fit each other.

    Source: thesis 4.2.10, equations 58 to 64.

    Example:
        >>> from torchface import zoo
        >>> prior = zoo.get_model("dynamics_prior").double()
        >>> still = torch.zeros(1, prior.window, len(prior.names), dtype=torch.float64)
        >>> mean, variance = prior(still)
        >>> bool(mean.abs().max() < 0.05), bool((variance > 0).all())
        (True, True)
    """

    center: Tensor
    coefficients: Tensor
    feature_scale: Tensor
    target_scale: Tensor
    gain: Tensor
    limits: Tensor
    basis: Tensor
    group_index: Tensor

    def __init__(
        self,
        names: Sequence[str],
        window: int,
        groups: Sequence[Sequence[int]],
        processes: GaussianProcesses,
        noise: MotionNoise,
        motion: UsualMotion,
        fps: float,
        input_noise: float = 0.0,
    ) -> None:
        super().__init__()
        count = len(names)
        if sorted(i for group in groups for i in group) != list(range(count)):
            raise ShapeError(f"dynamics prior: found groups {groups}, expected each of {count} shapes in one of them")
        basis = motion_basis(window).to(motion.center.dtype)
        shapes = {
            "center": (motion.center, (count,)),
            "coefficients": (motion.coefficients, (window, count)),
            "feature_scale": (motion.feature_scale, (basis.shape[1], count)),
            "target_scale": (motion.target_scale, (count,)),
            "gain": (motion.gain, (len(groups),)),
            "limits": (motion.limits, (2,)),
        }
        for name, (value, shape) in shapes.items():
            if tuple(value.shape) != shape:
                raise ShapeError(f"dynamics prior: found {name} {tuple(value.shape)}, expected {shape}")
            self.register_buffer(name, value.detach())
        self.names, self.window, self.fps = tuple(names), window, float(fps)
        self.groups = tuple(tuple(map(int, group)) for group in groups)
        self.input_noise = float(input_noise)
        self.processes, self.noise = processes, noise
        index = {row: i for i, group in enumerate(self.groups) for row in group}
        group_index = torch.tensor([index[row] for row in range(count)], dtype=torch.int64, device="cpu")
        self.register_buffer("basis", basis, persistent=False)
        self.register_buffer("group_index", group_index, persistent=False)

    @classmethod
    def fit(
        cls,
        takes: Sequence[Tensor],
        names: Sequence[str],
        window: int = 4,
        *,
        fps: float = 60.0,
        groups: Sequence[Sequence[int]] | None = None,
        input_noise: float = 0.0,
        settings: DynamicsSettings | None = None,
        progress: Progress | None = None,
    ) -> "DynamicsPrior":
        """Learns from takes, with cross-validation over takes that are left out in turn.

        The kernels' hyperparameters maximise the bound of the marginal likelihood (``gpytorch``). The gain of the
        processes and the noise are those that predict left-out takes best; of a single take its quarters are left out,
        of more than a hundred takes a hundredth at a time.

        Takes are read one after the other, in four passes that add up means, normal equations and statistics of the
        processes: memory is that of a few times the longest take's windows. What cannot be added up is learned from
        windows that are drawn from all: the hyperparameters from ``settings.subset``, the noise from 40,000 where there
        are more.

        Args:
            takes: weights of each take, (T,N), all at one frame rate (``Take.resampled``), a list or what reads them
                from a disk; windows with a NaN are left out.
            names: of the N shapes.
            window: J, at least 1.
            fps: frames a second of the takes.
            groups: :func:`face_regions` if absent.
            input_noise: standard deviation of noise that is added to the windows, not to what follows them: a prior
                for windows of solved weights should expect as much noise as these have, or it keeps their errors.
            settings: of the learning.
            progress: called with each step and how far it is.

        Raises:
            ShapeError: no takes, of another number of shapes, or too short for the window.
            NameMismatchError: a name stands twice.
            ValueRangeError: no window without a NaN, or a setting out of range.

        Source: thesis 4.2.10 and the appendix "Learning the prior".

        Example:
            >>> take = torch.linspace(0, 12, 120).sin()[:, None].square()
            >>> quick = DynamicsSettings(inducing=8, subset=60, iterations=2)
            >>> prior = DynamicsPrior.fit([take], ["jawOpen"], window=2, settings=quick).double()
            >>> rising = take[10:12].double()
            >>> bool(prior(rising[None])[0] > rising[-1])
            True
        """
        from torchface.capture.priors.dynamics_training import fit_dynamics_prior

        return fit_dynamics_prior(
            takes, names, window, fps=fps, groups=groups, input_noise=input_noise, settings=settings, progress=progress
        )

    @full_precision
    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the next frame.

        Args:
            windows: the last frames, the newest last, (B,J',N); of more than J the last J count.

        Returns:
            (B,N) and (B,N).

        Raises:
            ShapeError: fewer frames than the window, or another number of shapes.
        """
        windows = newest_frames(windows, self.window, len(self.names))
        motion = self.basis.T @ (windows - self.center)
        process_mean, process_variance = self.processes((motion / self.feature_scale).flatten(1))
        steps = (windows * self.coefficients).sum(1)
        scale = self.target_scale * self.gain[self.group_index]
        mean = windows[:, -1] + steps + scale * process_mean
        variance = scale.square() * process_variance.index_select(1, self.group_index)
        variance = variance + self.noise(moving_parts(windows, motion))
        return mean.clamp(self.limits[0], self.limits[1]), variance

    def energy(self, windows: Tensor) -> Quadratic:
        r"""How unlikely the next weights are.

        .. math:: E(w) = \tfrac12 \sum_i \frac{(w_i - m_i)^2}{V_i}

        which is :math:`-\log p` without its constant, the unit of ``ShapePrior.energy`` at strength 1.

        Args:
            windows: as of :meth:`forward`.

        Source: thesis 4.2.10, equation 65 with its weight 1/V for each shape.
        """
        return gaussian_term(*self(windows))

    def require(self, names: Sequence[str]) -> None:
        """Checks that a rig's shapes are the prior's.

        Raises:
            NameMismatchError: they are others, or in another order.
        """
        require_same_names(self.names, names)

    @property
    def config(self) -> dict[str, Any]:
        """From which :meth:`from_config` makes a prior for the state to be loaded into."""
        return {
            "names": list(self.names),
            "groups": [list(group) for group in self.groups],
            "window": self.window,
            "inducing": self.processes.inducing.shape[1],
            "fps": self.fps,
            "input_noise": self.input_noise,
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "DynamicsPrior":
        """A prior that has learned nothing, with the sizes of a ``config``.

        Raises:
            FileFormatError: a part of it is not what it should be.
        """
        values = Value("dynamics prior", "", config)
        names = values["names"].texts()
        groups = [group.tensor(None, dtype=torch.int64).tolist() for group in values["groups"].rows()]
        window, points = (values[name].whole(1, 2**20) for name in ("window", "inducing"))
        fps, input_noise = values["fps"].number(), values["input_noise"].number() if values["input_noise"] else 0.0
        n, orders, g = len(names), min(window, 3), len(groups)
        if not fps > 0 or window > _MAX_WINDOW or g * points * max(orders * n, points, n) > _MAX_NUMBERS:
            raise FileFormatError(
                f"dynamics prior: found {n} shapes in {g} groups, a window of {window} frames at {fps} a second and "
                f"{points} inducing points, expected a window of {_MAX_WINDOW} and {_MAX_NUMBERS} numbers at most"
            )
        inputs = orders * n
        processes = GaussianProcesses(
            torch.zeros(g, inputs),
            torch.zeros(g, points, inputs),
            torch.zeros(g),
            torch.zeros(g, points, points),
            torch.zeros(g, points, points),
            torch.zeros(g, points, n),
        )
        coefficients = torch.ones(0 if window == 1 else min(window, 3), n)
        noise = MotionNoise(torch.ones(n), coefficients, coefficients.clone(), coefficients.clone(), torch.zeros(n, n))
        return cls(
            names,
            window,
            groups,
            processes,
            noise,
            UsualMotion(
                center=torch.zeros(n),
                coefficients=torch.zeros(window, n),
                feature_scale=torch.ones(orders, n),
                target_scale=torch.ones(n),
                gain=torch.ones(g),
                limits=torch.zeros(2),
            ),
            fps=fps,
            input_noise=input_noise,
        )

    def check_state(self) -> None:
        """Refuses a state that no fit gives.

        Raises:
            ValueRangeError: a scale or variance that must be positive is not.
        """
        noise = self.noise
        positive = {
            "feature_scale": self.feature_scale,
            "noise.rest_variance": noise.rest_variance,
            "noise.scale": noise.scale,
        }
        for name, value in positive.items():
            if not bool((value > 0).all()):
                raise ValueRangeError(f"dynamics prior: found {name} that is not positive, expected all to be")
        if bool((noise.own_coefficients < 0).any()) or bool((noise.group_coefficients < 0).any()):
            raise ValueRangeError("dynamics prior: found negative coefficients of the noise, expected none")

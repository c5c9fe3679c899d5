"""Dynamics priors learned from takes; the window is chosen by predictions of a take left out."""

from torchface.capture.priors import DynamicsPrior, DynamicsSettings
from torchface.errors import ValueRangeError
from torchface.progress import Progress

from .prior_figures import calibration_picture, choice_picture, curves_picture
from .prior_settings import TRIED, LearnedPrior, Material, PriorSettings, for_choice, limits
from .prior_takes import PriorTakes
from .prior_trials import one_step

_WINDOWS = (2, 3, 4, 6, 8)


def learned_dynamics(settings: PriorSettings, material: Material, progress: Progress) -> LearnedPrior:
    """A dynamics prior; its window is chosen with the last of the takes to learn from, left out for that."""
    learn, test = material.learn, material.test
    how = DynamicsSettings(inducing=settings.inducing, iterations=settings.iterations, seed=settings.seed)

    def fitted(takes: PriorTakes, window: int) -> DynamicsPrior:
        return DynamicsPrior.fit(
            takes.weights, takes.names, window, fps=takes.fps, input_noise=settings.input_noise, settings=how
        )

    window = settings.window
    tried: dict[str, list[tuple[float, float]]] = {"negative log likelihood a weight": [], "one-step error": []}
    if window is None:
        fitting, choosing = for_choice(learn)
        shortest = min(*fitting.frames, *choosing.frames)
        for candidate in _WINDOWS:
            if shortest <= candidate + 8:
                continue
            progress(f"trying a window of {candidate} frames")
            found = one_step(fitted(fitting, candidate), choosing.weights, settings.input_noise).metrics()
            for key, values in tried.items():
                values.append((candidate, found[key]))
        scores = tried["one-step error"]
        if not scores:
            raise ValueRangeError(
                f"takes: the shortest has {shortest} frames, expected more than {_WINDOWS[0] + 8}, or a window"
            )
        window = int(min(scores, key=lambda point: point[1])[0])
    progress(f"fitting the dynamics prior with a window of {window} frames")
    prior = fitted(learn, window)
    trial = one_step(prior, test.spread(TRIED).weights, settings.input_noise)
    metrics = {"window": float(window)} | {f"held out, {key}": value for key, value in trial.metrics().items()}
    card = (
        f"Mean and variance of the next frame's weights from the last {window} frames at "
        f"{learn.fps:g} frames a second: Gaussian processes, one for each region of the face, and a noise that grows "
        "with the motion. Holds a solve to how faces move and interpolates frames without landmarks. "
        f"{limits(settings, material, 'The noise')} Windows carried noise of {settings.input_noise:g} a weight, in "
        "learning and in the test, as solved weights do. Errors are root mean squares in weights; the log likelihood "
        "leaves out its constant. The window was chosen on a take that was left out; the test takes took no part in "
        "that. A video of another frame rate needs a prior of that rate (--fps)."
    )
    pictures = {"calibration": calibration_picture(trial), "curves": curves_picture(prior, test.weights[0])}
    if settings.window is None:
        tables = {key: {"take left out": values} for key, values in tried.items()}
        pictures["window"] = choice_picture(tables, "window, frames")
    return LearnedPrior(prior, metrics, card, pictures)

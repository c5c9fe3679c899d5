"""Choice of the priors of a solve: read by name or folder, and brought to a rig's shapes and a video's frame rate."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from torch import nn

from torchface import zoo
from torchface.capture.priors import AdaptedDynamicsPrior, DynamicsPrior, ShapePrior, adapt_dynamics, unlearned
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.rig import BlendshapeRig
from torchface.shape_names import read_as_arkit

DEFAULT_PRIOR = "shape_prior"
"""Of the zoo; what weights faces have, where no other prior is named."""
NO_PRIOR = "none"
"""In place of a shape prior: none."""

# What people do with their eyes has little to do with what a prior's few takes did with theirs. So wide, it neither
# shuts nor opens lids.
_LIDS, _LID_DEVIATION = re.compile(r"eye_?(blink|wide|squint)", re.IGNORECASE), 0.5
# People combine shapes in ways that the synthetic takes of the prior by default never showed.
_DEFAULT_DEVIATION = 0.15

_Model = TypeVar("_Model", bound=nn.Module)
Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class FittedPriors:
    """Priors for a rig's shapes and a video's frame rate, and the shapes that they say nothing of."""

    shapes: ShapePrior | None
    dynamics: DynamicsPrior | AdaptedDynamicsPrior | None
    unlearned: tuple[str, ...]


def load_priors(
    rig: BlendshapeRig, prior: str | Path | None, dynamics: str | Path | None, fps: float | None = None
) -> FittedPriors:
    """Reads priors by name or folder and brings them to a rig and a frame rate.

    ``prior`` may be "none"; the one by default is left out where it has learned less than half of the rig's shapes.
    """
    prior = None if prior == NO_PRIOR else prior
    if prior == DEFAULT_PRIOR and not knows_half(zoo.get_model(DEFAULT_PRIOR, ShapePrior).names, rig):
        prior = None
    spread = _DEFAULT_DEVIATION if prior == DEFAULT_PRIOR else 0.0
    shapes = None if prior is None else read_model("--prior", prior, ShapePrior)
    motion = None if dynamics is None else read_model("--dynamics", dynamics, DynamicsPrior)
    silent = {name for model in (shapes, motion) if model is not None for name in unlearned(model.names, rig.names)}
    return FittedPriors(
        None if shapes is None else _fitted(prior, lambda: _widened(shapes.renamed(rig.names), spread)),
        None if motion is None else _fitted(dynamics, lambda: adapt_dynamics(motion, rig.names, fps)),
        tuple(name for name in rig.names if name in silent),
    )


def knows_half(names: Sequence[str], rig: BlendshapeRig) -> bool:
    """Whether at least half of a rig's shapes are among names."""
    return 2 * len(unlearned(names, rig.names)) <= len(rig.names)


def _widened(prior: ShapePrior, deviation: float) -> ShapePrior:
    """A prior wider by a deviation of each weight, and so wide for lids that it neither shuts nor opens them."""
    deviations = [_LID_DEVIATION if _LIDS.match(name) else deviation for name in read_as_arkit(prior.names)]
    return prior.widened(torch.tensor(deviations).square())


def _fitted(name: str | Path | None, fit: Callable[[], Fitted]) -> Fitted:
    """A prior brought to a rig's names and a video's rate; an error says which model it is of."""
    try:
        return fit()
    except (NameMismatchError, ValueRangeError) as error:
        raise type(error)(f"{name}: {error}") from error


def read_model(option: str, name: str | Path, kind: type[_Model]) -> _Model:
    model = zoo.get_model(name)
    if not isinstance(model, kind):
        raise NameMismatchError(f"{option}: found {name}, a {type(model).__name__}, expected a {kind.__name__}")
    return model


def model_folder(name: str | Path | None) -> Path | None:
    return None if name is None else zoo.find(name)

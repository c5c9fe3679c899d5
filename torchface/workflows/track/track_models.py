"""The learned parts that track a video: landmarks of any face, the actor's own appearance, what faces do."""

from __future__ import annotations

import functools
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
from torchface.files.content_keys import content_key
from torchface.landmarks import AppearanceModel
from torchface.landmarks.images.landmark_finder import LandmarkFinder
from torchface.modeling import HeadModel
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder

HEADS = "head"
"""Of the zoo; ways of being another person."""
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
class TrackModels:
    """What tracks and solves.

    Args:
        finder: finds landmarks in any face; absent where they are given.
        appearance: refines them on the actor's own.
        dynamics: how weights go on.
        unlearned: shapes of the rig that a prior says nothing of: they stay near rest.
        seeing: changes when what finds landmarks does.
        solving: changes when what solves does.
        expects: whether the finder reads which weights of the rig's shapes are to be expected: then solves have no
            other prior.
    """

    finder: LandmarkFinder | None
    appearance: AppearanceModel | None = None
    prior: ShapePrior | None = None
    dynamics: DynamicsPrior | AdaptedDynamicsPrior | None = None
    unlearned: tuple[str, ...] = ()
    seeing: str = ""
    solving: str = ""
    expects: bool = False


def is_table(landmarks: str | Path | None) -> bool:
    """Whether what a user names is a table of landmarks rather than what finds them."""
    return landmarks is not None and Path(landmarks).suffix.lower() == ".csv"


def load_track_models(
    rig: BlendshapeRig,
    landmarks: str | Path = DEFAULT_LANDMARKS,
    appearance: str | Path | None = None,
    prior: str | Path | None = DEFAULT_PRIOR,
    dynamics: str | Path | None = None,
    fps: float | None = None,
) -> TrackModels:
    """Reads models by name or folder, see :func:`torchface.zoo.get_model`, and makes priors fit the rig and the video.

    Args:
        rig: whose shapes' names the priors are brought to.
        landmarks, appearance, prior, dynamics: the models; for landmarks also a table of them; ``prior`` may be "none".
            The prior by default is left out where it has learned less than half of the rig's shapes.
        fps: frames a second of the video, to which the dynamics prior is brought; its own if absent.
    """
    named = None if is_table(landmarks) else load_finder(landmarks)
    priors = load_priors(rig, prior, dynamics, fps)
    learned = None if priors.shapes is None else _folder(prior)
    return TrackModels(
        None if named is None else named.finder,
        None if appearance is None else _read("--appearance", appearance, AppearanceModel),
        priors.shapes,
        priors.dynamics,
        priors.unlearned,
        content_key(
            "seeing", finder=Path(landmarks) if named is None else named.source, appearance=_folder(appearance)
        ),
        content_key("solving", prior=learned, dynamics=_folder(dynamics), fps=fps),
        named is not None and named.expects and prior == DEFAULT_PRIOR and _knows(ARKIT, rig),
    )


@dataclass(frozen=True)
class FittedPriors:
    """Priors for a rig's shapes and a video's frame rate, and the shapes that they say nothing of."""

    shapes: ShapePrior | None
    dynamics: DynamicsPrior | AdaptedDynamicsPrior | None
    unlearned: tuple[str, ...]


@functools.cache
def identity_modes() -> torch.Tensor:
    """What a standard deviation of each of K ways of being another person adds to the 68 landmarks, (K,68,3), of the
    zoo's model of heads.
    """
    heads = zoo.get_model(HEADS, HeadModel)
    if heads.landmarks is None:
        raise NameMismatchError(f"{HEADS}: found a HeadModel without landmarks, expected one with them")
    return heads.shape.modes[:, heads.landmarks].detach()


def load_priors(
    rig: BlendshapeRig, prior: str | Path | None, dynamics: str | Path | None, fps: float | None = None
) -> FittedPriors:
    """Reads priors and brings them to a rig and a frame rate; see :func:`load_track_models`."""
    prior = None if prior == NO_PRIOR else prior
    if prior == DEFAULT_PRIOR and not _knows(zoo.get_model(DEFAULT_PRIOR, ShapePrior).names, rig):
        prior = None
    spread = _DEFAULT_DEVIATION if prior == DEFAULT_PRIOR else 0.0
    shapes = None if prior is None else _read("--prior", prior, ShapePrior)
    motion = None if dynamics is None else _read("--dynamics", dynamics, DynamicsPrior)
    silent = {name for model in (shapes, motion) if model is not None for name in unlearned(model.names, rig.names)}
    return FittedPriors(
        None if shapes is None else _fitted(prior, lambda: _widened(shapes.renamed(rig.names), spread)),
        None if motion is None else _fitted(dynamics, lambda: adapt_dynamics(motion, rig.names, fps)),
        tuple(name for name in rig.names if name in silent),
    )


def _knows(names: Sequence[str], rig: BlendshapeRig) -> bool:
    """Whether at least half of a rig's shapes are among names."""
    return 2 * len(unlearned(names, rig.names)) <= len(rig.names)


def _widened(prior: ShapePrior, deviation: float) -> ShapePrior:
    """A prior wider by a deviation of each weight, and so wide for lids that it neither shuts nor opens them."""
    deviations = [_LID_DEVIATION if _LIDS.match(name) else deviation for name in prior.names]
    return prior.widened(torch.tensor(deviations).square())


def _fitted(name: str | Path | None, fit: Callable[[], Fitted]) -> Fitted:
    """A prior brought to a rig's names and a video's rate; an error says which model it is of."""
    try:
        return fit()
    except (NameMismatchError, ValueRangeError) as error:
        raise type(error)(f"{name}: {error}") from error


def _read(option: str, name: str | Path, kind: type[_Model]) -> _Model:
    model = zoo.get_model(name)
    if not isinstance(model, kind):
        raise NameMismatchError(f"{option}: found {name}, a {type(model).__name__}, expected a {kind.__name__}")
    return model


def _folder(name: str | Path | None) -> Path | None:
    return None if name is None else zoo.find(name)

"""The learned parts that track a video: landmarks of any face, the actor's own appearance, what faces do."""

import functools
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.capture.priors import AdaptedDynamicsPrior, DynamicsPrior, ShapePrior
from torchface.errors import NameMismatchError
from torchface.files.content_keys import content_key
from torchface.landmarks import AppearanceModel
from torchface.landmarks.images.landmark_finder import LandmarkFinder
from torchface.modeling import HeadModel
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder
from torchface.workflows.named_priors import DEFAULT_PRIOR, knows_half, load_priors, model_folder, read_model

HEADS = "head"
"""Of the zoo; ways of being another person."""


@dataclass(frozen=True)
class TrackModels:
    """What tracks and solves."""

    finder: LandmarkFinder | None  # finds landmarks in any face; absent where they are given
    appearance: AppearanceModel | None = None  # refines them on the actor's own
    prior: ShapePrior | None = None
    dynamics: DynamicsPrior | AdaptedDynamicsPrior | None = None  # how weights go on
    unlearned: tuple[str, ...] = ()  # shapes of the rig that a prior says nothing of: they stay near rest
    seeing: str = ""  # changes when what finds landmarks does
    solving: str = ""  # changes when what solves does
    # whether the finder reads which weights of the rig's shapes are to be expected: then solves have no other prior
    expects: bool = False
    # of the points that the finder finds beside the 68, on the embedded performer's sculpture, (P,3) mm
    places: Tensor = field(default_factory=lambda: torch.zeros(0, 3))


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

    Landmarks may also be a table, ``prior`` "none"; the one by default is left out where it has learned less than half
    of the rig's shapes.
    """
    named = None if is_table(landmarks) else load_finder(landmarks, "film")
    priors = load_priors(rig, prior, dynamics, fps)
    learned = None if priors.shapes is None else model_folder(prior)
    return TrackModels(
        None if named is None else named.finder,
        None if appearance is None else read_model("--appearance", appearance, AppearanceModel),
        priors.shapes,
        priors.dynamics,
        priors.unlearned,
        content_key(
            "seeing both sides",
            finder=Path(landmarks) if named is None else named.source,
            appearance=model_folder(appearance),
        ),
        content_key("solving", prior=learned, dynamics=model_folder(dynamics), fps=fps),
        named is not None and named.expects and prior == DEFAULT_PRIOR and knows_half(ARKIT, rig),
        torch.zeros(0, 3) if named is None else named.places,
    )


@functools.cache
def identity_modes() -> torch.Tensor:
    """What a standard deviation of each of K ways of being another person adds to the 68 landmarks, (K,68,3), of the
    zoo's model of heads.
    """
    heads = zoo.get_model(HEADS, HeadModel)
    if heads.landmarks is None:
        raise NameMismatchError(f"{HEADS}: found a HeadModel without landmarks, expected one with them")
    return heads.shape.modes[:, heads.landmarks].detach()

"""The webcam's solver as commands use it: on the embedded performer's mean head, for anybody."""

from __future__ import annotations

from torchface import zoo
from torchface.capture.anybody import WebcamSettings, WebcamSolver
from torchface.errors import NameMismatchError
from torchface.modeling import HeadModel
from torchface.synthetic.head.performer import performer
from torchface.workflows.track.track_models import DEFAULT_PRIOR, load_priors

__all__ = ["default_webcam_solver"]

HEADS = "head"
"""The model of the zoo that says which heads there are."""


def default_webcam_solver(settings: WebcamSettings | None = None) -> WebcamSolver:
    """The solver of the embedded performer's mean head, with the zoo's model of heads and prior of weights.

    Raises:
        NameMismatchError: the zoo's model of heads is another kind of model.

    Example:
        >>> default_webcam_solver().names[:2]
        ('eyeBlinkLeft', 'eyeLookDownLeft')
    """
    rig = performer(texture=False)
    heads = zoo.get_model(HEADS, HeadModel)
    if heads.landmarks is None:
        raise NameMismatchError(f"{HEADS}: found a HeadModel without landmarks, expected one with them")
    modes = heads.shape.modes[:, heads.landmarks]
    return WebcamSolver(rig, modes, load_priors(rig, DEFAULT_PRIOR, None).shapes, settings)

"""A rig from a neutral face alone: learned expressions where they are better, transferred ones elsewhere."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import NameMismatchError, TopologyError
from torchface.mesh import Mesh
from torchface.modeling.rigging.deformation_transfer import transfer_deformation
from torchface.modeling.rigging.expression_regression import STILL, ExpressionRegression
from torchface.number_checks import checked_type
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping


@dataclass(frozen=True, eq=False)
class NeutralRig:
    """A rig made from a neutral face alone, and why each shape is what it is.

    Args:
        rig: of N shapes.
        transferred: the same by deformation transfer alone.
        known: shapes that the regression has, (N,) bool.
        learned: those that are its prediction, (N,) bool.
        expected: error of prediction and of transfer to be expected, root mean square over the vertices, millimetres,
            (2,N); NaN where nobody has measured it.
        distance: of the neutral from the people learned from, see :meth:`ExpressionRegression.distance`.
    """

    rig: BlendshapeRig
    transferred: BlendshapeRig
    known: Tensor
    learned: Tensor
    expected: Tensor
    distance: float


def rig_from_neutral(regression: ExpressionRegression, template: BlendshapeRig, neutral: Mesh) -> BlendshapeRig:
    """A whole personal rig from one neutral face; :func:`neutral_rig` says why each shape is what it is.

    Shapes of the template that the regression has, in any spelling that ``shape_names`` reads, are predicted; the
    others come by deformation transfer, and so do those for which the regression expects the larger error for this
    face. A predicted whole is divided between a template's halves as transfer does.

    Args:
        regression: in the template's topology.
        template: N shapes.
        neutral: the person, of the same topology, millimetres, in any pose.

    Returns:
        A rig of ``neutral`` with the template's names in their order.

    Raises:
        TopologyError: regression, template and neutral have not the same topology.
        NameMismatchError: the regression has none of the template's shapes.

    Source: thesis 3.3.4 for predicted shapes, 3.3.1 for the others.

    Example:
        >>> from torchface import zoo
        >>> from torchface.synthetic import performer
        >>> template = performer(texture=False).select(["jawOpen", "mouthSmileLeft"])
        >>> rig = rig_from_neutral(zoo.get_model("expressions"), template, template.neutral)
        >>> rig.names
        ('jawOpen', 'mouthSmileLeft')
    """
    return neutral_rig(regression, template, neutral).rig


def neutral_rig(regression: ExpressionRegression, template: BlendshapeRig, neutral: Mesh) -> NeutralRig:
    r"""The rig of :func:`rig_from_neutral` beside that of deformation transfer, with the errors to be expected.

    A shape is predicted where

    .. math:: e_{regression} \, (1 + d^2) \le e_{transfer}

    with the squared errors for people left out in training, and the neutral's distance d from those learned from; a
    regression without such a comparison predicts all shapes that it has.

    Args:
        regression, template, neutral: as for :func:`rig_from_neutral`, which raises the same errors.

    Example:
        >>> from torchface import zoo
        >>> from torchface.synthetic import performer
        >>> template = performer(texture=False).select(["jawOpen", "mouthClose"])
        >>> neutral_rig(zoo.get_model("expressions"), template, template.neutral).learned.tolist()
        [True, False]
    """
    checked_type("regression", regression, ExpressionRegression)
    checked_type("template", template, BlendshapeRig)
    expected = checked_type("neutral", neutral, Mesh).fingerprint()
    for what, found in (("template", template.neutral.fingerprint()), ("regression", regression.topology)):
        if found is not None and found != expected:
            raise TopologyError(
                f"rig_from_neutral: found a {what} of topology {found}, expected the neutral's, {expected} "
                "(vertex count, hash of the triangles)"
            )
    if len(regression.neutral_mean) != len(neutral.vertices):
        raise TopologyError(
            f"rig_from_neutral: found a regression of {len(regression.neutral_mean)} vertices, expected the "
            f"neutral's {len(neutral.vertices)}"
        )
    translation = mapping(regression.names, template.names)
    known = translation.any(1)
    if not known.any():
        raise NameMismatchError(
            f"rig_from_neutral: found a regression of {', '.join(regression.names[:5])}, expected some of the "
            f"template's shapes, {', '.join(template.names[:5])}, ..."
        )
    with torch.no_grad():
        predicted = regression.offsets(neutral.vertices[None].float())[0]
        distance = float(regression.distance(neutral.vertices[None].float()))
    parts = (translation > 0).to(predicted)
    # All of them: a shape that undoes another is transferred on top of it.
    transferred = transfer_deformation(template, neutral)
    # Deltas of halves add up to those of their whole.
    named = torch.einsum("nm,mvc->nvc", parts, predicted)
    split = (translation > 0) & ((translation > 0).sum(0) > 1)
    named = (named * _shares_of_the_whole(transferred.deltas, split)).to(transferred.deltas)
    squared = _expected_errors(regression, parts, distance)
    learned = known & ~(squared[0] > squared[1])
    deltas = torch.where(learned[:, None, None], named, transferred.deltas)
    rig = BlendshapeRig(neutral, deltas, template.names, transferred.correctives)
    return NeutralRig(rig, transferred, known, learned, (squared / len(neutral.vertices)).sqrt(), distance)


def _expected_errors(regression: ExpressionRegression, parts: Tensor, distance: float) -> Tensor:
    """Squared errors of prediction and transfer for a face so far away, mm², (2,N); NaN where they are not known."""
    if regression.errors is None:
        return parts.new_full((2, len(parts)), torch.nan)
    squared = regression.errors.to(parts) @ parts.T
    squared[0] *= 1 + distance**2
    return squared.masked_fill(squared[1] <= 0, torch.nan)


def _shares_of_the_whole(transferred: Tensor, split: Tensor) -> Tensor:
    """What part of a predicted whole each shape moves at each vertex, (N,V,1): as the transferred halves (N,V,3)
    divide it."""
    size = transferred.norm(dim=-1)
    shares = torch.ones_like(size)
    for column in split.any(0).nonzero()[:, 0]:  # one or two shapes of a rig are split
        rows = split[:, column].nonzero()[:, 0]
        shares[rows] = (size[rows] + STILL) / (size[rows] + STILL).sum(0)
    return shares[..., None]

"""The open-eyed neutral of a person who was scanned with closed eyes."""

from collections.abc import Sequence

from torchface.errors import NameMismatchError
from torchface.mesh import Mesh
from torchface.modeling.rigging.deformation_transfer import CONTACT_WEIGHT, transfer_with_report
from torchface.number_checks import checked_type
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping

_BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")
# After the second the lids still move, no longer toward the true ones.
_ITERATIONS = 2


def open_eyes(
    template: BlendshapeRig, closed: Mesh, shapes: Sequence[str] | None = None, contact_weight: float = CONTACT_WEIGHT
) -> Mesh:
    r"""Opens the eyes of a face as the template opens its own.

    Deformation transfer with the template's blink as the reference pose and its neutral as the deformed one: with
    :math:`G_{a \to b}` the gradients from pose a to pose b,

    .. math:: \min_{\tilde x} \sum_t \lVert G_{A_0 + A_{blink} \to A_0} - T_t(\tilde x) \rVert_F^2.

    Transfer there and back is not quite the same: the result is then corrected, so that the template's blinks,
    transferred to it, close the eyes as scanned. Lids that fold are difficult to register to a scan; closed ones are
    smooth.

    Args:
        template: a rig with shapes that close the eyes, millimetres.
        closed: the person with closed eyes, in the template's topology, millimetres.
        shapes: the template's shapes that close the eyes; ARKit's two blinks, in any rig's spelling, if absent.
        contact_weight: as in ``transfer_deformation``.

    Returns:
        The face with open eyes; nothing else moves but what the template's blinks move.

    Raises:
        NameMismatchError: the template has no such shapes.
        TopologyError: the face has another topology than the template.

    Source: thesis 3.3.3, results; Sumner and Popovic 2004.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False)
        >>> blink = actor.vertices + actor.deltas[actor.index(["eyeBlinkLeft", "eyeBlinkRight"])].sum(0)
        >>> opened = open_eyes(actor, actor.neutral.with_vertices(blink))
        >>> bool((opened.vertices - actor.vertices).norm(dim=1).max() < 1)  # millimetres
        True
    """
    checked_type("template", template, BlendshapeRig)
    if shapes is None:
        means_blink = mapping(_BLINKS, template.names).any(1)
        if not means_blink.any():
            raise NameMismatchError(
                f"template: found no shape that means eyeBlinkLeft or eyeBlinkRight among its {len(template.names)} "
                f"({', '.join(template.names[:5])}, ...), expected both; name those that close the eyes"
            )
        shapes = [name for name, yes in zip(template.names, means_blink.tolist(), strict=True) if yes]
    blinks = template.select(shapes)
    closing = blinks.deltas.sum(0)
    reference = template.neutral.with_vertices(template.vertices + closing)
    opening = BlendshapeRig(reference, -closing[None], ["eyesOpen"])
    opened = closed.vertices + transfer_with_report(opening, closed, contact_weight).rig.deltas[0].to(closed.vertices)
    for _ in range(_ITERATIONS):
        own = transfer_with_report(blinks, closed.with_vertices(opened), contact_weight).rig
        opened = closed.vertices - own.deltas.sum(0).to(closed.vertices)
    return closed.with_vertices(opened)

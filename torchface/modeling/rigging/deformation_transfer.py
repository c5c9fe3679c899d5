"""A template's blendshapes on a new face, by deformation transfer."""

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import TopologyError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.modeling.rigging.part_clearance import clear_parts
from torchface.modeling.rigging.penetration import inner_parts
from torchface.modeling.rigging.transfer_system import ShapeTransfer
from torchface.number_checks import checked_number, checked_type
from torchface.progress import Progress
from torchface.registration.own_topology import check_own_topology
from torchface.rig import BlendshapeRig

CONTACT_WEIGHT = 30.0
"""Weight of a contact pair beside the squared gradient error of one triangle, a square millimetre."""

_ANOTHER_FACE = 0.01  # millimetres; a target that differs by less is the template, and has the template's own shapes


@dataclass(frozen=True, eq=False)
class TransferReport:
    """What a transfer found on its way.

    Args:
        similarity: the global similarity from the source's neutral to the target, taken out first and put back.
        flat_source: triangles without area in the source's neutral, (K,); they prescribe nothing.
        flat_target: triangles without area in the target, (K,); they are prescribed nothing.
        flat_shapes: by shape name, triangles that lose their area in the source's shape; their edges still count.
        contacts: by shape name, how many contact pairs were asked to keep their gap.
        undoes: by the name of a shape that only makes sense on top of another, the name of that other.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False).select(["jawOpen"])
        >>> transfer_with_report(actor, actor.neutral).report.summary()
        ''
    """

    similarity: Similarity
    flat_source: Tensor
    flat_target: Tensor
    flat_shapes: dict[str, Tensor]
    contacts: dict[str, int]
    undoes: dict[str, str]

    def summary(self) -> str:
        """One line on triangles that have no area in the target but in the source; empty where there are none.

        Those of the source are its own at each transfer: ``torchface info`` says them.
        """
        lost = len(set(self.flat_target.tolist()) - set(self.flat_source.tolist()))
        return f"triangles without area in the target: {lost}" if lost else ""


@dataclass(frozen=True, eq=False)
class TransferredRig:
    """A transferred rig and the report of how it came about.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False).select(["jawOpen"])
        >>> transferred = transfer_with_report(actor, actor.neutral)
        >>> transferred.rig.names
        ('jawOpen',)
    """

    rig: BlendshapeRig
    report: TransferReport


def transfer_deformation(
    source: BlendshapeRig, target: Mesh, contact_weight: float = CONTACT_WEIGHT, progress: Progress | None = None
) -> BlendshapeRig:
    r"""Gives a new face the shapes of a template rig.

    .. math:: \min_{\tilde x} \sum_t \lVert S_t - T_t(\tilde x) \rVert_F^2

    for each shape, with the source's gradients S. The global similarity between the faces is removed first and carried
    by the deltas, so that a rotated or scaled target has rotated or scaled shapes. Vertices that a shape leaves still
    are pinned. Parts of a head that are not connected to the face (teeth, eyes, lashes) keep what offset to it they
    keep in the source, and give way where they would come through the skin, also where the source's do. Lids close and
    lips meet as the source's do. The source's own face gets the source's own shapes.

    Args:
        source: the template: N shapes, V vertices, millimetres; its correctives are transferred too.
        target: the new neutral, of the same topology, millimetres.
        contact_weight: how firmly lids and lips keep their gap; 0 leaves that out, and lets parts come through.
        progress: called with each step and how far it is.

    Returns:
        A rig of ``target`` with the source's names; solved in float64 on the CPU. Triangles without area are
        survived, with a warning where only the target's have none; ``transfer_with_report`` gives the details.

    Raises:
        TopologyError: source and target have other triangles, or none.
        AlignmentError: the target is a mirror image, or its vertices stand in another order: more than 5 % of its edges
            are over five times as long as the source's, or a sixteenth of them or more are shifted.
        ValueRangeError: the source has no shapes, the target has collapsed or another unit, or the weight is negative.

    Source: thesis 3.3.1; Sumner and Popovic 2004.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False).select(["jawOpen", "browInnerUp"])
        >>> larger = actor.neutral.with_vertices(1.5 * actor.vertices)
        >>> rig = transfer_deformation(actor, larger)
        >>> torch.allclose(rig.deltas, 1.5 * actor.deltas, atol=0.05)
        True
    """
    transferred = transfer_with_report(source, target, contact_weight, progress)
    if summary := transferred.report.summary():
        warnings.warn(f"transfer_deformation: {summary}", stacklevel=2)
    return transferred.rig


def transfer_with_report(
    source: BlendshapeRig, target: Mesh, contact_weight: float = CONTACT_WEIGHT, progress: Progress | None = None
) -> TransferredRig:
    """The same as ``transfer_deformation``, with a report in place of a warning.

    Example:
        >>> from torchface.synthetic import performer
        >>> actor = performer(texture=False).select(["jawOpen"])
        >>> larger = actor.neutral.with_vertices(1.5 * actor.vertices)
        >>> report = transfer_with_report(actor, larger).report
        >>> round(report.similarity.scale.item(), 3), len(report.flat_target)
        (1.5, 0)
    """
    _check(source, target, contact_weight)
    job = ShapeTransfer(source, target, contact_weight)
    moved = job.transfer(progress)
    if contact_weight > 0 and float((job.goal - job.rest).abs().max()) > _ANOTHER_FACE:
        own = BlendshapeRig(target.to("cpu").with_vertices(job.goal), moved, source.names)
        moved = clear_parts(own, inner_parts(source)).deltas
    correctives = job.correctives(source, progress)
    return TransferredRig(job.rig(source, target, moved, correctives), transfer_report(job, source.names))


def transfer_report(job: ShapeTransfer, names: tuple[str, ...]) -> TransferReport:
    """What a job that has solved its shapes found."""
    return TransferReport(
        job.similarity,
        job.flat.nonzero()[:, 0],
        job.flat_target.nonzero()[:, 0],
        {name: ids for name, ids in zip(names, job.flat_shapes, strict=True) if len(ids)},
        dict(zip(names, job.contacts, strict=True)),
        {names[shape]: names[other] for shape, other in job.seams.undoes.items()},
    )


def _alike(source: Mesh, target: Mesh) -> str:
    same = len(source.vertices) == len(target.vertices) and len(source.faces) == len(target.faces)
    return ", as many, which join other vertices: it was exported in another order," if same else ""


def _check(source: BlendshapeRig, target: Mesh, contact_weight: float) -> None:
    checked_type("source", source, BlendshapeRig)
    checked_type("target", target, Mesh)
    if len(source.names) == 0:
        raise ValueRangeError("transfer_deformation: the source rig has 0 shapes; expected at least one")
    if len(source.neutral.faces) == 0:
        raise TopologyError("transfer_deformation: the source rig has no triangles; expected a mesh")
    if source.neutral.fingerprint() != target.fingerprint():
        raise TopologyError(
            f"transfer_deformation: found a target of {len(target.vertices)} vertices and {len(target.faces)} "
            f"triangles{_alike(source.neutral, target)} ({target.fingerprint()}), expected the source's topology of "
            f"{len(source.neutral.vertices)} vertices and {len(source.neutral.faces)} triangles "
            f"({source.neutral.fingerprint()}); a head of another topology is first laid out in it by "
            "torchface register, or rigged at once by torchface rig"
        )
    for what, vertices in (("source", source.vertices), ("target", target.vertices)):
        if not torch.isfinite(vertices).all():
            raise ValueRangeError(f"transfer_deformation: found NaN or infinite vertices in the {what}; expected none")
    checked_number("contact_weight", contact_weight)
    check_own_topology(source.neutral, target)

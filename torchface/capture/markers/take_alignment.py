"""The alignment of a take with a rig, and the mean residual between its markers and their sites."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.given_markers import check_labels
from torchface.capture.markers.helmet_motion import EXPRESSIONS, free_motion
from torchface.capture.markers.marker_solver import MarkerSolver
from torchface.capture.markers.rest_pose import (
    check_not_collinear,
    check_not_mirrored,
    pose_of_points,
    pose_of_take,
    sample_limits,
)
from torchface.errors import ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.number_checks import checked_type
from torchface.rig import BlendshapeRig
from torchface.take import Take

_FRAMES = 240


def align_take(
    rig: BlendshapeRig,
    attachment: Attachment,
    take: Take,
    neutral_frame: int | None = None,
    insist: bool = False,
    scale: bool = True,
) -> Similarity:
    r"""The similarity that moves a take's markers into the rig's space; every take has its own.

    With a neutral frame, that frame is aligned with the rig at rest. Without one (a take may hold none) the similarity
    and the weights of frames spread over the take are found by alternation:

    .. math:: \min_{s,R,t,\,w} \sum_{t,m} \lVert s R y_{tm} + t - b_m - B_m w_t \rVert^2, \quad 0 \le w \le 1

    Samples that stay far from their sites do not count, so exchanged labels and spikes do not move it. Of a head that
    moves freely in the volume the scale is that of the markers without this motion; the rest is that of a middle pose.

    Args:
        rig: the performer's.
        attachment: where the markers sit; markers match by label, and a ``residual`` is added to the sites.
        take: markers (T,M,3), millimetres of any space.
        neutral_frame: a frame with the face at rest.
        insist: also align markers that are a mirror image of their sites, as well as turning can.
        scale: estimate the scale; otherwise it is 1, as it is for the performer's own rig and a take in true
            millimetres.

    Returns:
        One similarity, marker space to rig space, float64.

    Raises:
        NameMismatchError: the take has no markers, or one that the attachment does not know.
        ValueRangeError: no such frame, or a coordinate is infinite.
        ShapeError: fewer than three markers are seen in the neutral frame.
        AlignmentError: the markers lie on a line, or are mirrored, unless ``insist``.
        TopologyError: the attachment belongs to another mesh.

    Source: thesis 4.1.2.

    Example:
        >>> from torchface import Track
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks)
        >>> seen = sites.on(rig.neutral.faces, rig.vertices) / 10  # a stage in centimetres
        >>> take = Take(60.0, markers=Track(sites.labels, seen[None]))
        >>> round(align_take(rig, sites, take, neutral_frame=0).scale.item(), 3)
        10.0
    """
    checked_type("rig", rig, BlendshapeRig)
    checked_type("take", take, Take)
    checked_type("attachment", attachment, Attachment).check(rig.neutral)
    rig = rig.linear("align_take")
    affine, paths = _seen_sites(rig, attachment, take)
    rest = affine[..., 0]
    if not insist:
        check_not_mirrored(paths, rest, str(take.extras.get("source", "take")), take.extras.get("flipped"))
    if neutral_frame is not None:
        if not 0 <= neutral_frame < len(paths):
            raise ValueRangeError(
                f"neutral frame: found a take of {len(paths)} frames, expected frame {neutral_frame} among them"
            )
        frame = paths[neutral_frame]
        check_not_collinear(frame[~torch.isnan(frame).any(-1)])
        return pose_of_points(frame, rest, scale)
    check_not_collinear(paths.nanmedian(0).values)
    few = paths[:: max(1, len(paths) // _FRAMES)]
    few = few[~torch.isnan(few).any(-1).all(1)]
    motion = free_motion(few, EXPRESSIONS) if scale else None
    if motion is None:
        return pose_of_take(affine, few, scale)
    # Markers that move far are nearest to sites that do not where all of them shrink to a point.
    size = pose_of_take(affine, motion.undo(few)).scale
    return replace(pose_of_take(affine, size * few, scale=False), scale=size)


def rest_residual(
    rig: BlendshapeRig, attachment: Attachment, take: Take, alignment: Similarity | None = None, iterations: int = 1
) -> Attachment:
    r"""The attachment with the mean distance between markers and solved sites over a take as its ``residual``.

    .. math:: r_m = \frac{1}{|T_m|} \sum_{t \in T_m} (s R y_{tm} + t - p_m(w_t))

    A marker's error of its site, or its stand-off, then no longer biases the weights of any frame. The mean
    is over the whole solved take, since a take may hold no neutral frame, without samples far from the marker's median.

    Args:
        rig: the performer's.
        attachment: where the markers sit; a residual that it has is the initial one.
        take: the one to be solved.
        alignment: marker space to rig space; none if absent.
        iterations: of solving and taking the mean.

    Returns:
        The attachment with a residual (M,3), millimetres in rig space; a marker that the take never shows keeps its
        residual.

    Source: thesis 4.1.2, after algorithm 4.

    Example:
        >>> from torchface import Track
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks)
        >>> seen = sites.on(rig.neutral.faces, rig.vertices) + torch.tensor([0.0, 0.0, 3.0])
        >>> take = Take(60.0, markers=Track(sites.labels, seen[None]))
        >>> off = rest_residual(rig, sites, take, iterations=4).residual.mean(0)
        >>> off[2].item() > 1.0  # millimetres that the markers stand off the skin
        True
    """
    for _ in range(iterations):
        solver = MarkerSolver(rig, attachment, alignment)
        assert take.markers is not None
        markers = solver.arrange(take.markers)
        shown = ~torch.isnan(markers).any(-1).all(1)
        markers = markers[shown].double()
        on_rig = solver.points(solver(markers))
        moved = markers if alignment is None else alignment.apply(markers)
        residual = moved - on_rig
        steady = (residual - residual.nanmedian(0).values).norm(dim=-1)
        residual = torch.where((steady <= sample_limits(steady))[..., None], residual, torch.nan).nanmean(0)
        before = torch.zeros_like(residual) if attachment.residual is None else attachment.residual.double()
        attachment = replace(attachment, residual=(before + residual.nan_to_num(0.0)).float())
    return attachment


def _seen_sites(rig: BlendshapeRig, attachment: Attachment, take: Take) -> tuple[Tensor, Tensor]:
    """Affine maps (M,3,N+1) of the sites whose markers the take shows, and their paths (T,M,3), float64."""
    labels = tuple(attachment.labels or ())
    track = take.markers
    check_labels(() if track is None else track.names, labels)
    assert track is not None
    shown = [
        label
        for label in labels
        if label in track.names and not torch.isnan(track.select([label]).values).any(-1).all()
    ]
    if not shown:
        raise ValueRangeError("markers: found none that is seen in any frame, expected at least three")
    paths = track.select(shown).values.double()
    if torch.isinf(paths).any():
        raise ValueRangeError("markers: found infinite coordinates, expected millimetres, or NaN for not seen")
    sites = attachment.select(shown)
    faces = rig.neutral.faces
    rest = sites.on(faces, rig.vertices.double())
    if sites.residual is not None:
        rest = rest + sites.residual.double()
    basis = sites.on(faces, rig.deltas.double()).permute(1, 2, 0)
    return torch.cat([rest[..., None], basis], dim=2), paths

"""Markers as an animation of the model's dense mesh."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture import align_take
from torchface.capture.markers.helmet_motion import steady_take
from torchface.capture.markers.rest_pose import check_not_collinear, check_not_mirrored
from torchface.enhancement.thin_shell import LEAST_POINTS, ThinShell, rigid_motion
from torchface.errors import AlignmentError, ShapeError, TopologyError
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.similarity import Similarity, similarity_transform
from torchface.mesh import Mesh, other_topology
from torchface.rig import BlendshapeRig
from torchface.take import Take
from torchface.temporal.interpolation import interpolated
from torchface.workflows.enhance.coarse_animation import CoarseAnimation, check_scale, resampling_note
from torchface.workflows.enhance.head_correspondence import PLACE, HeadCorrespondence, placed
from torchface.workflows.marker_input import MarkerOptions, read_markers, row_of

_SAME_SIZE = 0.05
_MOST_AT_REST_MM = 15.0
_FAR_MM = 3.0
_EXCHANGED = 0.5  # two labels are exchanged where that leaves less than this part of their distances from their sites
_ASTRAY_MM = 100.0  # from its site, the head's motion taken out: no face moves a marker so far


@dataclass(frozen=True, eq=False)
class MarkerSites:
    """Where markers sit on the model, and the rig that says so."""

    attachment: Attachment
    rig: BlendshapeRig | None = None  # whose mesh it belongs to; None where that is the model's
    correspondence: HeadCorrespondence | None = None  # how the rig's neutral lies on the model's, where there is a rig

    def on_model(self, model: Mesh) -> Attachment:
        """The same sites on the model's triangles."""
        if self.rig is None or self.correspondence is None:
            return self.attachment
        points = self.attachment.on(self.rig.neutral.faces, self.correspondence.bent)
        nearest = SurfaceIndex(model.vertices, model.faces).nearest(points)
        far = nearest.distance > _FAR_MM
        if far.any():
            names = [label for label, off in zip(self.attachment.labels or (), far.tolist(), strict=True) if off]
            raise AlignmentError(
                f"attachment: found the sites of {', '.join(names[:5])} {float(nearest.distance.max()):.1f} mm from "
                f"the model's surface, expected at most {_FAR_MM:g}; the rig is another head, or they sit where the "
                "model has no surface"
            )
        barycentric = nearest.barycentric.float()
        return Attachment(nearest.triangle, barycentric, self.attachment.labels, self.attachment.residual)


def check_attachment(attachment: Attachment, path: Path, rig: BlendshapeRig | None, model: Mesh) -> bool:
    """Whether an attachment belongs to the model's own mesh.

    Raises:
        TopologyError: it belongs to neither the model nor the rig.
        ShapeError: it has fewer than 12 markers.
    """
    if len(attachment.triangles) < LEAST_POINTS:
        raise ShapeError(f"{path}: found {len(attachment.triangles)} markers, expected at least {LEAST_POINTS}")
    if rig is not None and attachment.fingerprint != model.fingerprint():
        attachment.check(rig.neutral, path, "the rig")
        return False
    if attachment.fingerprint is not None and attachment.fingerprint != model.fingerprint():
        raise TopologyError(
            f"{path}: found marker sites made for {other_topology(attachment.fingerprint, model, 'the model')}; give "
            "the rig that they belong to (--rig)"
        )
    attachment.check(model, path, "the model")
    return True


def marker_animation(
    path: Path, sites: MarkerSites, model: Mesh, neutral: int | None, options: MarkerOptions
) -> CoarseAnimation:
    """A take of markers, spread over the model by the thin shell; motion counts from the frame ``neutral``, else from
    the sites.

    A marker that is not seen in a frame holds nothing there. Frames that show fewer than 12 are interpolated from those
    before and after.
    """
    take, notes = read_markers(path, sites.attachment.labels, options)
    neutral = None if neutral is None else row_of(neutral, take.numbers)
    if take.seconds is not None:
        if neutral is not None:
            neutral = int((take.resampled().times - take.times[neutral]).abs().argmin())
        uneven, take = take, take.resampled()
        notes = [*notes, resampling_note(path, uneven, take)]
    assert take.markers is not None
    attachment = sites.on_model(model).select(take.markers.names)
    if len(attachment.triangles) < LEAST_POINTS:
        raise ShapeError(
            f"{path}: found {len(attachment.triangles)} of the attachment's markers, expected at least {LEAST_POINTS}"
        )
    shell = ThinShell(model.vertices, model.faces, attachment)
    pose = _pose(path, take, sites, shell, neutral)
    check_scale(float(pose.scale[0]), path)
    samples = placed(pose, take.markers.values)
    if attachment.residual is not None:
        samples = samples - attachment.residual.to(samples)
    markers, gap_notes = _without_gaps(samples, take.numbers, path)
    rest = shell.rest
    away = _from_sites(rest, markers)
    offsets = float(away.square().sum(-1).nanmean(-1).sqrt().quantile(0.05))
    labels = attachment.labels or ()
    exchanged = _exchanged(rest, away, labels)
    if offsets > _MOST_AT_REST_MM:
        raise AlignmentError(
            f"{path}: found markers {offsets:.1f} mm (root mean square) from their sites where they come nearest, "
            f"expected at most {_MOST_AT_REST_MM:g}; "
            + ("; ".join(exchanged) or "the attachment or the rig is another one's, or labels are mixed up")
        )
    off = away.norm(dim=-1).where(torch.isfinite(samples).all(-1), 0.0)
    astray = off > _ASTRAY_MM
    if astray.any():
        frame, marker = divmod(int(off.argmax()), len(labels))
        markers, gap_notes = _without_gaps(samples.masked_fill(astray[..., None], torch.nan), take.numbers, path)
        gap_notes.append(
            f"warning: samples more than {_ASTRAY_MM:g} mm from their sites are left out: {int(astray.sum())}, at "
            f"worst {labels[marker]} in frame {int(take.numbers[frame])} by {float(off.max()):.0f} mm"
        )
    if neutral is not None:
        seen = markers[neutral]
        still = rigid_motion(rest.double(), seen[None].double()).inverse().apply(seen[None].double())[0].float()
        rest = torch.where(torch.isfinite(still), still, rest)
    site_notes = [f"{len(attachment.triangles)} markers, {offsets:.2f} mm (root mean square) from their sites at rest"]
    site_notes += [f"warning: {line}" for line in exchanged]
    if offsets > 3.0 and neutral is None and not exchanged:
        site_notes.append(
            f"warning: at rest the markers lie {offsets:.1f} mm from their sites; a frame with the face at rest "
            "(--neutral) or the attachment of this take (torchface attach) would keep that out of the motion"
        )
    return CoarseAnimation(
        path,
        f"{len(attachment.triangles)} markers",
        len(take),
        lambda begin, end: shell.follow(markers[begin:end], rest),
        take.fps,
        lambda begin, end: markers[begin:end],
        None,
        offsets,
        (*notes, *site_notes, *gap_notes, PLACE),
    )


def _pose(path: Path, take: Take, sites: MarkerSites, shell: ThinShell, neutral: int | None) -> Similarity:
    """From the take's space to the model's."""
    assert take.markers is not None
    # The mean places of a head that moves freely are those of a smaller face.
    take, _ = steady_take(take)
    assert take.markers is not None
    if sites.rig is not None and sites.correspondence is not None:
        pose = align_take(sites.rig, sites.attachment, take, neutral)
        onto = sites.correspondence.pose
        rotation, scale = onto.rotation @ pose.rotation.to(onto.rotation), onto.scale * pose.scale.to(onto.scale)
        translation = onto.apply(pose.translation.to(onto.translation)[:, None])[0]
        return Similarity(scale, rotation, translation)
    paths = take.markers.values.double()
    check_not_mirrored(paths, shell.rest.double(), str(path), take.extras.get("flipped"))
    middle = paths.nanmedian(0).values if neutral is None else paths[neutral]
    check_not_collinear(middle[torch.isfinite(middle).all(-1)])
    pose = similarity_transform(middle[None], shell.rest.double()[None])
    if abs(float(pose.scale[0]) - 1) < _SAME_SIZE:  # millimetres as they should be: an open jaw does not shrink a head
        pose = similarity_transform(middle[None], shell.rest.double()[None], scale=False)
    return pose


def _without_gaps(markers: Tensor, numbers: Tensor, path: Path) -> tuple[Tensor, list[str]]:
    """Frames (T,M,3) with too few markers get those of the frames before and after, linear in between; their numbers
    (T,) are for the notes."""
    enough = torch.isfinite(markers).all(-1).sum(1) >= LEAST_POINTS
    rows = enough.nonzero()[:, 0]
    if len(rows) == 0:
        raise ShapeError(f"{path}: found no frame that shows {LEAST_POINTS} markers, expected at least one")
    if enough.all():
        return markers, []
    filled = markers.clone()
    filled[~enough] = interpolated(markers[rows], rows, len(markers))[~enough]
    still = torch.isfinite(filled).all(-1).sum(1) < LEAST_POINTS
    if still.any():  # the frames beside show other markers
        nearest = torch.searchsorted(rows, still.nonzero()[:, 0]).clamp(max=len(rows) - 1)
        filled[still] = markers[rows[nearest]]
    first = int(numbers[~enough][0])
    return filled, [
        f"warning: {int((~enough).sum())} of {len(markers)} frames (the first {first}) show fewer than {LEAST_POINTS} "
        "markers; they are interpolated from the frames before and after"
        + ("" if enough[0] and enough[-1] else ", and held at the take's ends")
    ]


def _from_sites(rest: Tensor, markers: Tensor) -> Tensor:
    """Ways (T,M,3) of markers from their sites at rest, the head's motion taken out."""
    return rigid_motion(rest.double(), markers.double()).inverse().apply(markers.double()) - rest.double()


def _exchanged(rest: Tensor, away: Tensor, labels: Sequence[str]) -> list[str]:
    """Words on each two markers that stand at each other's sites in the frame that is nearest to rest."""
    own = away[int(away.square().sum(-1).nanmean(-1).nan_to_num(torch.inf).argmin())]
    apart = torch.cdist(rest.double() + own, rest.double())
    off = own.norm(dim=-1)
    found = (apart + apart.T < _EXCHANGED * (off[:, None] + off)) & (torch.minimum(off[:, None], off) > _FAR_MM)
    return [
        f"the labels {labels[a]} and {labels[b]} seem to be exchanged: the markers lie {float(off[a]):.1f} mm "
        "from their own sites, and on each other's; rename them (--labels)"
        for a, b in found.triu(1).nonzero().tolist()
    ]

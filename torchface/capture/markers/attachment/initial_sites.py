"""An automatic initial guess of marker sites: the markers' mean shape aligned with the face."""

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers.marker_labels import sided_pairs
from torchface.capture.markers.rest_pose import check_not_collinear
from torchface.capture.markers.rig_fit_check import unit_of_scale
from torchface.capture.markers.surface_motion import SurfaceMotion
from torchface.errors import AlignmentError, ValueRangeError
from torchface.escaped_text import listed
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.meshes.rigid_icp import Samples, ScanPoints, find_pose
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.spheres import nearest_sphere
from torchface.rig import BlendshapeRig
from torchface.take import Take

_NEIGHBOURS, _MIN_MARKERS = 9, 12
_MIN_MOTION = 0.5
# So many pairs of labels with a side show whether a take is mirrored, if most of them agree.
_MIN_PAIRS, _MOST_CROSSED = 3, 0.8
_MIN_SIZE_RATIO, _MAX_SIZE_RATIO = 0.4, 2.0


def sites_by_shape(rig: BlendshapeRig, rom: Take) -> Attachment:
    """Sites for the markers of a range of motion, found by aligning their mean positions with the skin that moves.

    Rigid alignment from starts in all directions by iterated closest points, the scale within a quarter of 1: units
    must be right. The result is accurate to millimetres, as a guess by eye; ``fit_attachment`` refines it.

    Args:
        rig: the performer's.
        rom: markers (T,M,3), spread over the face, at least twelve.

    Returns:
        An attachment with the take's labels, (M,).

    Raises:
        ValueRangeError: the take has fewer than twelve markers, or one is seen in no frame.
        AlignmentError: the markers lie on a line, or fit nowhere.

    Source: thesis 4.1.2, where the landmarks are picked by hand.
    """
    track = rom.markers
    if track is None or len(track.names) < _MIN_MARKERS:
        count = 0 if track is None else len(track.names)
        raise ValueRangeError(
            f"markers: found {count}, expected at least {_MIN_MARKERS} to find the pose by their shape"
        )
    points = track.values.double().nanmean(0)
    unseen = [name for name, point in zip(track.names, points, strict=True) if not bool(torch.isfinite(point).all())]
    if unseen:
        raise ValueRangeError(f"markers: {', '.join(unseen[:5])} seen in no frame, expected each at least once")
    check_not_collinear(points)
    motion = SurfaceMotion.of(rig)
    vertices = motion.points[..., 0]
    moves = motion.points[..., 1:].norm(dim=1).amax(1) > _MIN_MOTION
    faces = motion.faces[motion.skin & moves[motion.faces].all(1)]
    if not len(faces):
        raise ValueRangeError(f"rig: found no skin that moves by more than {_MIN_MOTION} mm, expected a face")
    normals = vertex_normals(vertices, motion.faces)
    # What faces away from the viewer, such as the inside of lips and lids, carries no marker.
    faces = faces[normals[faces].mean(1)[:, 2] > 0]
    skin = vertices[faces.unique()]
    size = float((points - points.mean(0)).norm(dim=1).mean() / (skin - skin.mean(0)).norm(dim=1).mean())
    if not _MIN_SIZE_RATIO < size < _MAX_SIZE_RATIO:
        unit = unit_of_scale(1 / size, rom.extras.get("unit"))
        seems = f"the take seems to be in {unit} (--unit {unit})" if unit else "is the take's unit right?"
        raise AlignmentError(
            f"markers: found them spread {size:.2g} times as far as the skin that moves, expected {_MIN_SIZE_RATIO} to "
            f"{_MAX_SIZE_RATIO} times: {seems}; else give initial sites by --initial (torchface pick --mode markers)"
        )
    try:
        pose = find_pose(Samples(points, _outward(points)), ScanPoints.of(vertices, faces)).pose
    except AlignmentError as error:
        raise AlignmentError(
            f"markers: by their shape alone they lie nowhere on the face: {error}; "
            "give initial sites by --initial (torchface pick --mode markers)"
        ) from None
    rows = (motion.skin & moves[motion.faces].all(1)).nonzero()[:, 0]
    on_skin = SurfaceIndex(vertices, motion.faces[rows]).nearest(pose.apply(points)[0])
    return Attachment(rows[on_skin.triangle], on_skin.barycentric.float(), track.names).made_for(rig.neutral)


def crossed_sides(sites: Attachment, rig: BlendshapeRig) -> str | None:
    """What says that sites found by shape are mirrored: labels of the left that lie on the right.

    Empty where they lie on the left; None where too few labels say a side.
    """
    labels = sites.labels or ()
    pairs = sided_pairs(labels)
    if len(pairs) < _MIN_PAIRS:
        return None
    x = sites.on(rig.neutral.faces, rig.vertices)[:, 0].tolist()
    crossed = [f"{labels[left]} and {labels[right]}" for left, right in pairs if x[left] < x[right]]
    if len(crossed) <= _MOST_CROSSED * len(pairs):
        return ""
    return (
        f"{listed(crossed)} lie on the other side of the face than they say: the coordinates are left-handed (--flip "
        "x), or the labels say the viewer's left (--initial says roughly where they sit)"
    )


def _outward(points: Tensor) -> Tensor:
    """Unit normals (M,3) of the surface that markers lie on: planes through neighbours, away from the head's middle."""
    near = points[torch.cdist(points, points).argsort(1)[:, :_NEIGHBOURS]]
    normals = torch.linalg.svd(near - near.mean(1, keepdim=True)).Vh[:, 2]
    centre = nearest_sphere(points)[0]
    return normals * torch.sign((normals * (points - centre)).sum(1, keepdim=True))

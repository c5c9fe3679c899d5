"""Where a template starts on a scan: the similarity by landmarks or by its shape, and which side of the scan is out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

from torch import Tensor

from torchface.errors import AlignmentError
from torchface.geometry.meshes.rigid_icp import Samples, ScanPoints, find_pose, fit_of, rigid_icp
from torchface.geometry.meshes.surface_index import SurfaceIndex
from torchface.geometry.similarity import MAX_HEAD_SCALE, MIN_HEAD_SCALE, Similarity
from torchface.mesh import Mesh
from torchface.registration.nonrigid.correspondence import evenly_spread, exposed_vertices
from torchface.registration.nonrigid.landmark_pull import LandmarkPull
from torchface.registration.nonrigid.schedule import Schedule
from torchface.registration.scan_preparation import Landmarks, PreparedScan, check_landmarks

_RIGID_SAMPLES = 1500
_OTHER_SHARE, _BESIDE = 0.15, 0.1  # of the scan's points; of the template's size
_RIGID_REACHES = (20.0, 17.0, 14.0, 12.0, 10.0, 8.0)
_FREE_REACHES = (*_RIGID_REACHES, *_RIGID_REACHES[-1:] * 6)
# Millimetres between where landmarks and where the face's shape put it: without fault at most 3.2 (71 heads and scans,
# with noise, holes, in expressions, halves), moved by 8 mm at least 7.
_MOVED = 5.0
_SIZES, _SURE_FIT = (1.0, 0.85, 1.15), 0.6  # of a template that looks for its place by shape; of its face there

Detector = Callable[[Mesh, Mesh, Similarity], Landmarks | None]
"""Finds landmarks by itself: given the template aligned with the scan, the scan, and the similarity from the one's own
space to the other's; gives template vertex ids and scan points, or nothing."""


@dataclass(frozen=True, eq=False)
class StartOnScan:
    """Where a template starts, and the scan it starts on."""

    by: str  # landmarks, detected landmarks or shape
    pose: Similarity
    pull: LandmarkPull
    prepared: PreparedScan
    surface: SurfaceIndex
    notes: tuple[str, ...]


def start_on_scan(
    template: Mesh,
    scan: Mesh,
    prepared: PreparedScan,
    landmarks: Landmarks | None,
    detector: Detector | None,
    schedule: Schedule,
) -> StartOnScan:
    """The pose, by landmarks or shape, and the scan with its outside out."""
    vertices, faces = template.vertices.detach().cpu().double(), template.faces.cpu()
    exposed = exposed_vertices(vertices, faces, schedule.opening).nonzero()[:, 0]
    samples = Samples.of(vertices, faces, evenly_spread(vertices, exposed, _RIGID_SAMPLES))
    by, surface, notes, fit = "landmarks", SurfaceIndex(prepared.vertices, prepared.faces), list[str](), 1.0
    if landmarks is None:
        by = "shape"
        fit, pose, notes = _pose_by_shape(template, samples, ScanPoints.of(prepared.vertices, prepared.faces), exposed)
        if detector is not None:
            aligned = template.with_vertices(pose.apply(vertices)[0].to(template.vertices))
            landmarks = detector(aligned, scan, pose)
            by = "detected landmarks" if landmarks is not None else by
    if landmarks is None:
        if fit < _SURE_FIT and scale_notes(pose):
            raise AlignmentError(
                f"register: by its shape alone the template fits the scan best at {float(pose.scale[0]):.3g} times its "
                f"size, where it fits {fit:.2f} of 1; expected {MIN_HEAD_SCALE} to {MAX_HEAD_SCALE} times, as heads "
                f"differ, or a fit of {_SURE_FIT}: is it half a head, or another unit? Give landmarks"
            )
        return StartOnScan(by, pose, LandmarkPull.none(), prepared, surface, (*prepared.notes, *notes))
    (ids, points), pose, note = check_landmarks(landmarks, template, surface)
    notes = [note] if note else []
    if _faces_away(samples, surface, pose):
        prepared = prepared.turned()
        surface = SurfaceIndex(prepared.vertices, prepared.faces)
    targets = ScanPoints.of(prepared.vertices, prepared.faces)
    pose = rigid_icp(samples, targets, pose, _RIGID_REACHES, scale=True, landmarks=(vertices[ids], points)).pose
    notes += _moved_alike(_of_face(template, samples, exposed), targets, pose, (vertices[ids], points))
    return StartOnScan(by, pose, LandmarkPull.of(ids, points, template), prepared, surface, (*prepared.notes, *notes))


def _pose_by_shape(
    template: Mesh, samples: Samples, scan: ScanPoints, exposed: Tensor
) -> tuple[float, Similarity, list[str]]:
    """How well the face fits, the pose in which it fits best, and a note where that is not well.

    By the whole template, or by its face alone where the rest (shoulders, another hairdo) is not on the scan; larger
    and smaller where it fits in neither way.
    """
    face = _of_face(template, samples, exposed)
    try:
        best, pose = _best_pose(samples, face, scan, _SIZES)
    except AlignmentError as error:
        raise AlignmentError(
            f"register: the template lies nowhere on the scan by its shape alone: {error}; give landmarks"
        ) from error
    if best >= _SURE_FIT:
        return best, pose, _other_heads(samples, face, scan, pose)
    note = (
        f"warning: the face was found by its shape alone and fits {best:.2f} of 1 there, where heads fit {_SURE_FIT} "
        "and more: look at the registered mesh (torchface register writes NAME.glb and contact_sheet.png), and give "
        "landmarks if it lies elsewhere"
    )
    return best, pose, [note]


def _of_face(template: Mesh, samples: Samples, exposed: Tensor) -> Samples:
    """Of the face's region, where the template has it; else those of the template."""
    notes = template.annotations
    if notes is None or "face" not in notes.regions or int(notes.regions["face"].cpu()[exposed].sum()) < 3:
        return samples
    ids, vertices = exposed[notes.regions["face"].cpu()[exposed]], template.vertices.detach().cpu().double()
    return Samples.of(vertices, template.faces.cpu(), evenly_spread(vertices, ids, _RIGID_SAMPLES))


def _moved_alike(face: Samples, scan: ScanPoints, pose: Similarity, landmarks: tuple[Tensor, Tensor]) -> list[str]:
    """A warning where the face's shape alone draws the template (L,3) away from all landmarks (L,3) alike: the mesh
    slides along the skin to where they are, which no distance shows."""
    at, points = landmarks
    free = rigid_icp(face, scan, pose, _FREE_REACHES, scale=True).pose
    off = (points - free.apply(at)[0]).median(0).values
    if float(off.norm()) <= _MOVED:
        return []
    x, y, z = off.tolist()
    return [
        f"warning: the landmarks lie {float(off.norm()):.0f} mm beside where the scan's shape has them, moved alike by "
        f"about ({x:.0f}, {y:.0f}, {z:.0f}) mm in the scan's axes; at most {_MOVED:g} mm is usual: are they another "
        "scan's, or was the scan moved since? Look at them on the registered mesh, or leave them out"
    ]


def _best_pose(samples: Samples, face: Samples, scan: ScanPoints, sizes: Sequence[float]) -> tuple[float, Similarity]:
    """How well the face fits, and the pose: the first of the template or its face that is sure, else the best."""
    best, pose, refused = -1.0, None, AlignmentError("")
    for size, some in product(sizes, (samples,) if face is samples else (samples, face)):
        try:
            found = find_pose(some, scan, size).pose
        except AlignmentError as error:
            refused = error
            continue
        fit = float(fit_of(face, scan, found, float(found.scale) * _RIGID_REACHES[-1])[0])
        if fit > best:
            best, pose = fit, found
        if best >= _SURE_FIT:
            break
    if pose is None:
        raise refused
    return best, pose


def _other_heads(samples: Samples, face: Samples, scan: ScanPoints, found: Similarity) -> list[str]:
    """A note on a second place where the face fits, if much of the scan lies beside the template there."""
    places = found.inverse().apply(scan.points)[0]
    low, high = samples.points.amin(0), samples.points.amax(0)
    margin = _BESIDE * (high - low)
    left = ((places < low - margin) | (places > high + margin)).any(1)
    if float(left.double().mean()) < _OTHER_SHARE:
        return []
    rest = ScanPoints(scan.points[left], scan.normals[left], scan.border[left])
    try:
        fit, other = _best_pose(samples, face, rest, (float(found.scale[0]),))
    except AlignmentError:
        return []
    if fit < _SURE_FIT:
        return []
    taken, not_taken = (
        "("
        + ", ".join(f"{number:.0f}" for number in pose.apply(face.points.mean(0, keepdim=True))[0, 0].tolist())
        + ")"
        for pose in (found, other)
    )
    return [
        f"warning: the face fits in more than one place: the one at {taken} was taken, another is at {not_taken}, "
        "millimetres; cut the scan to one head, or give landmarks"
    ]


def scale_notes(pose: Similarity) -> list[str]:
    """What to say of a pose that gives a template a size that no head has."""
    scale = float(pose.scale[0])
    if MIN_HEAD_SCALE <= scale <= MAX_HEAD_SCALE:
        return []
    return [
        f"warning: the template was aligned with the scan at {scale:.3g} times its size, heads differ by "
        f"{MIN_HEAD_SCALE} to {MAX_HEAD_SCALE} times: are both in millimetres, and the landmarks this scan's?"
    ]


def _faces_away(samples: Samples, surface: SurfaceIndex, pose: Similarity) -> bool:
    """Whether most normals of the scan oppose the template's where both are near each other."""
    nearest = surface.among_nearest_samples(pose.apply(samples.points)[0])
    agree = (surface.normals_at(nearest) * (samples.normals @ pose.rotation[0].double().T)).sum(-1)
    near = nearest.distance <= nearest.distance.median()
    return float(agree[near].mean()) < 0

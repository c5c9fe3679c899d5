"""Pairs of template vertex and scan point for registration: the twelve landmarks, and points along lips and lids."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.errors import TopologyError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.landmarks.scans.face_frame import FaceFrame
from torchface.landmarks.scans.scan_landmarks import ScanLandmarks, scan_landmarks
from torchface.landmarks.scans.uv_detector import UVLandmarkDetector
from torchface.landmarks.scans.uv_landmark_names import IBUG_ROWS, LINES, UV_LANDMARK_NAMES, uv_landmarks_from_ibug
from torchface.mesh import Mesh

_LINE_POINTS = 24
_SAME_LINE = 12.0


@dataclass(frozen=True, eq=False)
class LandmarkPairs:
    """Where vertices of a template lie on a scan.

    Args:
        vertices: ids on the template, (K,) int64.
        points: on the scan, (K,3), millimetres.
        confidence: of each, (K,) in [0,1].
        names: what each belongs to: a landmark's name, or a line's name.

    Example:
        >>> ids, points = torch.tensor([7, 9]), torch.zeros(2, 3)
        >>> pairs = LandmarkPairs(ids, points, torch.tensor([0.9, 0.1]), ("nose", "right_cheek"))
        >>> pairs.above(0.5).names
        ('nose',)
    """

    vertices: Tensor
    points: Tensor
    confidence: Tensor
    names: tuple[str, ...]

    def above(self, confidence: float) -> "LandmarkPairs":
        """Those with more than this confidence."""
        keep = self.confidence > confidence
        names = tuple(name for name, kept in zip(self.names, keep.tolist(), strict=True) if kept)
        return LandmarkPairs(self.vertices[keep], self.points[keep], self.confidence[keep], names)


@dataclass(frozen=True, eq=False)
class TemplateFeatures:
    """Where a template has the landmarks and lines: found once, used for every scan."""

    landmarks: dict[str, int]
    # By name, vertex ids (N,) and their shares (N,) in [0,1] of the line's length, from its left end.
    lines: dict[str, tuple[Tensor, Tensor]]


def template_features(template: Mesh, detector: UVLandmarkDetector | None = None) -> TemplateFeatures:
    """The twelve landmarks and the three lines on a template.

    Annotated iBUG landmarks are taken where there are 68. Lines are taken from the pairs of vertices that touch when
    lids and lips close (both vertices of a pair lie on the line that a scan with closed eyes shows), where annotated.
    What is not annotated is detected as on a scan; a template without colours, on which a detector that needs them
    sees nothing, has its twelve landmarks from the 68 and no lines.
    """
    notes = template.annotations
    ibug = None if notes is None or notes.landmarks is None or len(notes.landmarks) != 68 else notes.landmarks
    pairs = None if notes is None or notes.contacts is None or not len(notes.contacts) else notes.contacts
    sees = detector is not None and detector.sees(template)
    if not sees and (ibug is None or (pairs is None and detector is None)):
        raise ValueRangeError(
            "template: found no 68 landmarks or no contact pairs among its annotations, expected both or a detector "
            "that sees the template"
        )
    detected = None
    if detector is not None and sees and (ibug is None or pairs is None):
        detected = scan_landmarks(detector, template)
    landmarks = _annotated_landmarks(template, ibug) if ibug is not None else _nearest(template, detected)
    lines = _lines_of_contacts(template, pairs, landmarks) if pairs is not None else {}
    if detected is not None:
        lines = {**_lines_of_traces(template, detected, _LINE_POINTS), **lines}
    return TemplateFeatures(landmarks, lines)


def scan_pairs(features: TemplateFeatures, found: ScanLandmarks, scan: Mesh) -> LandmarkPairs:
    """Pairs a template's features with those found on a scan.

    The points of a line go to the same share of the line's length in 3D: lips and lids stretch evenly. A line is as
    sure as the less sure of its corners.
    """
    vertices, points, confidence, names = [], [], [], []
    for i, name in enumerate(found.names):
        if name in features.landmarks:
            vertices.append(torch.tensor([features.landmarks[name]]))
            points.append(found.points[i : i + 1])
            confidence.append(found.confidence[i : i + 1])
            names.append(name)
    for name in LINES:
        if name not in features.lines or name not in found.contours:
            continue
        ids, shares = features.lines[name]
        places, trusted = found.line_points(scan, name, shares)
        ends = [found.names.index(end) for end in LINES[name]]
        vertices.append(ids[trusted])
        points.append(places[trusted])
        confidence.append(found.confidence[ends].min().expand(int(trusted.sum())))
        names += [name] * int(trusted.sum())
    if not vertices:
        raise ValueRangeError("scan_pairs: found no landmark that template and scan share, expected some")
    dtype = found.points.dtype
    return LandmarkPairs(
        torch.cat(vertices), torch.cat(points), torch.cat([c.to(dtype) for c in confidence]), tuple(names)
    )


def _annotated_landmarks(template: Mesh, ibug: Tensor) -> dict[str, int]:
    named = {name: int(ibug[row]) for name, row in IBUG_ROWS.items()}
    named_points = uv_landmarks_from_ibug(template.vertices[ibug].double())
    for name in ("right_cheek", "left_cheek"):
        distance = (template.vertices.double() - named_points[UV_LANDMARK_NAMES.index(name)]).norm(dim=-1)
        named[name] = int(distance.argmin())
    return named


def _nearest(template: Mesh, found: ScanLandmarks | None) -> dict[str, int]:
    if found is None:
        return {}
    rows = torch.cdist(found.points.double(), template.vertices.double()).argmin(1)
    return {name: int(row) for name, row in zip(found.names, rows, strict=True)}


def _lines_of_contacts(template: Mesh, pairs: Tensor, landmarks: dict[str, int]) -> dict[str, tuple[Tensor, Tensor]]:
    """Each line's pairs are those between its two corners; shares are measured along the pairs' midpoints."""
    vertices = template.vertices.double()
    middle = vertices[pairs].mean(1)
    lines = {}
    for name, (left, right) in LINES.items():
        if left not in landmarks or right not in landmarks:
            continue
        start, end = vertices[landmarks[left]], vertices[landmarks[right]]
        chord = end - start
        along = (middle - start) @ chord / (chord @ chord)
        distance = (middle - start - along[:, None] * chord).norm(dim=-1)
        own = (along > 0) & (along < 1) & (distance < _SAME_LINE)
        if int(own.sum()) < 2:
            continue
        own = own.nonzero()[:, 0]
        own = own[_outermost(middle[own], chord, vertices.mean(0))]
        own = own[along[own].argsort()]
        path = torch.cat([start[None], middle[own], end[None]])
        steps = (path[1:] - path[:-1]).norm(dim=-1).cumsum(0)
        shares = (steps / steps[-1])[:-1]
        lines[name] = (pairs[own].flatten(), shares.repeat_interleave(2))
    return lines


def _outermost(points: Tensor, chord: Tensor, inside: Tensor) -> Tensor:
    """Which points (K,3) have none before them, seen from outside: lids are thick and touch on all of their edge, and a
    scan shows where they begin to.

    One lies before another where it is further out than aside: a line itself is nowhere that steep.
    """
    along = torch.nn.functional.normalize(chord, dim=0)
    outward = points.mean(0) - inside
    outward = torch.nn.functional.normalize(outward - (outward @ along) * along, dim=0)
    apart = points - points[:, None]
    out = apart @ outward
    aside = (apart - out[..., None] * outward).norm(dim=-1)
    return ~(out > aside).any(1)


def _lines_of_traces(template: Mesh, found: ScanLandmarks, points: int) -> dict[str, tuple[Tensor, Tensor]]:
    lines = {}
    for name in found.contours:
        shares = torch.linspace(0, 1, points, dtype=torch.float64)
        places, trusted = found.line_points(template, name, shares)
        rows = torch.cdist(places.double(), template.vertices.double()).argmin(1)
        lines[name] = (rows[trusted], shares[trusted])
    return lines


class AutomaticLandmarks:
    """Finds pairs for ``register``: called with the template aligned with a scan, the scan, and the similarity from the
    template's own space to the scan's; gives template vertex ids (K,) and scan points (K,3).

    Only sure pairs are given. Where the image is unlike those learned from (open eyes, another skin), filters agree
    on little, confidence is low, and registration goes by shape alone instead of by guesses.

    Args:
        detector: fitted with a frame.
        template: as it will be registered, in its own space.
        confidence: pairs below it are left out.
        without_colors: asked about scans that have no colours, where ``detector`` needs them; no landmarks are found
            on those if absent.

    Raises:
        TopologyError: when called with another template.
        ValueRangeError: a detector without a frame, or no face in the template.
    """

    def __init__(
        self,
        detector: UVLandmarkDetector,
        template: Mesh,
        confidence: float = 0.01,
        without_colors: UVLandmarkDetector | None = None,
    ) -> None:
        self.detectors = tuple(one for one in (detector, without_colors) if one is not None)
        self.confidence = confidence
        self._poses = [_framed(one).locate(template) for one in self.detectors]
        seeing = [one for one in self.detectors if one.sees(template)]
        self.features = template_features(template, seeing[0] if seeing else detector)
        self._count = len(template.vertices)

    def __call__(self, aligned: Mesh, scan: Mesh, pose: Similarity) -> tuple[Tensor, Tensor] | None:
        """Pairs, or nothing where too few are sure."""
        if len(aligned.vertices) != self._count:
            raise TopologyError(f"template: found {len(aligned.vertices)} vertices, expected {self._count}")
        for detector, own in zip(self.detectors, self._poses, strict=True):
            if detector.sees(scan):
                detected = scan_landmarks(detector, scan, _after(own, pose.inverse()))
                pairs = scan_pairs(self.features, detected, scan).above(self.confidence)
                return None if len(pairs.vertices) < 3 else (pairs.vertices, pairs.points)
        return None


def _framed(detector: UVLandmarkDetector) -> FaceFrame:
    if detector.frame is None:
        raise ValueRangeError("detector: found one without a FaceFrame, expected one fitted with frame=")
    return detector.frame


def _after(second: Similarity, first: Similarity) -> Similarity:
    """First one, then the other."""
    rotation = second.rotation.double() @ first.rotation.double()
    moved = second.apply(first.translation.double()[:, None])[:, 0]
    return Similarity(second.scale.double() * first.scale.double(), rotation, moved)

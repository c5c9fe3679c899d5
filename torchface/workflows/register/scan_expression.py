"""Expression of a raw scan, as the landmark network reads it from the front.

A registered mesh does not say it: without landmarks it slides along the skin, and a smile's corners of the mouth lie
elsewhere on it than the person's.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchface.geometry.similarity import similarity_transform
from torchface.landmarks.images.box_landmarks import settled_face
from torchface.landmarks.images.face_reading import FaceReading
from torchface.landmarks.images.ibug_68 import COUNT, box_around
from torchface.mesh import Mesh
from torchface.registration import Registration
from torchface.registration.scan_colors import has_colors, without_colors
from torchface.registration.scan_registration import FALSE_COLORS
from torchface.rendering.clay_shading import render
from torchface.shape_names import ARKIT, mapping
from torchface.viz.figures.face_views import frame_face
from torchface.workflows.named_finders import load_finder

_WIDTH, _HEIGHT = 480, 600
_LEAST_PRESENCE = 0.9
# Of 10 scans at rest (ICT's people, a real one with its colours and without) no shape but the eyes' has more than 0.32;
# of 15 that smile, pucker, sneer, raise brows or open the jaw by 0.7 the strongest has 0.54 at least.
_THERE = 0.45
_NAMED = 4


@dataclass(frozen=True, eq=False)
class FrontView:
    """What the landmark network reads of a scan's face, and whether it saw the scan's colours."""

    reading: FaceReading
    colored: bool


def front_view(scan: Mesh, registration: Registration, reference: Mesh) -> FrontView | None:
    """A registered scan from the front, upright as a reference of the template's topology; None where no face is seen
    or the template has no 68 landmarks."""
    notes = registration.mesh.annotations
    if notes is None or notes.landmarks is None or len(notes.landmarks) != COUNT:
        return None
    colored = has_colors(scan) and not any(note.startswith(FALSE_COLORS) for note in registration.record.notes)
    mesh = registration.mesh.vertices.detach().cpu().double()
    upright = similarity_transform(mesh[None], reference.vertices.detach().cpu().double()[None], scale=False)
    placed = scan.with_vertices(upright.apply(scan.vertices.detach().cpu().double())[0].to(scan.vertices))
    camera = frame_face(reference, width=_WIDTH, height=_HEIGHT)
    picture = render(placed if colored else without_colors(placed), camera, samples=1)
    box = box_around(camera.project(upright.apply(mesh[notes.landmarks.cpu()])[0]).float())
    reading = settled_face(load_finder().finder, (picture.clamp(0, 1) * 255).round().to(torch.uint8), box, 0.0)
    return FrontView(reading, colored) if float(reading.presence) >= _LEAST_PRESENCE else None


def shown_expression(view: FrontView, names: tuple[str, ...] = (), known: Tensor | None = None) -> str:
    """The shapes that a scan shows, such as ``mouthSmileLeft=0.9``; empty at rest. Eyes do not count, which the shape
    of a scan hardly shows; nor does what is known, weights (N,) by name."""
    found = view.reading.expression.double()
    if known is not None:
        found = found - mapping(names, ARKIT).double() @ known.double()
    order = [i for i in found.argsort(descending=True).tolist() if found[i] > _THERE and not ARKIT[i].startswith("eye")]
    return " ".join(f"{ARKIT[i]}={min(float(found[i]), 1.0):.1f}" for i in order[:_NAMED])

"""The head measured as anthropometry does, between vertices that mean something."""

from __future__ import annotations

from torch import Tensor

from torchface.mesh import Mesh
from torchface.synthetic.head.facial_openings import lid_order
from torchface.synthetic.head.head_annotations import head_annotations
from torchface.synthetic.head.topology import EAR_RIM, EYE_RIM, topology

WING_ROW, WING_COLUMN = 19, 5
JAW_ANGLE_ROW, JAW_ANGLE_COLUMN = 31, 19


def measure(head: Mesh) -> dict[str, float]:
    """Lengths in millimetres by name of a performer's head, those of ``IDENTITY`` whose mean is a measurement.

    Args:
        head: a mesh of the embedded performer's topology.
    """
    t, v = topology(), head.vertices.double()
    marks = v[head.landmarks]
    skin = v[head_annotations().regions["face"] | head_annotations().regions["cranium"]]
    rim = v[t.rings["eye"][EYE_RIM]]
    inner, outer = rim[lid_order()[0][[0, 16]]]
    balls = [v[head_annotations().regions[f"eyeball_{side}"]] for side in ("left", "right")]
    low = skin[(skin[:, 1] > -45) & (skin[:, 1] < 5) & (skin[:, 2] > 5)]
    ear = v[t.rings["ear"][EAR_RIM]]
    span = lambda points, axis: float(points[:, axis].max() - points[:, axis].min())  # noqa: E731
    return {
        "head_length": span(skin[skin[:, 1] > 8], 2),
        "head_width": span(skin[skin[:, 1] > 8], 0),
        "head_height": float(skin[:, 1].max() - _middle(balls[0])[1]),
        "face_width": span(low, 0),
        "jaw_width": 2 * float(v[t.grid[JAW_ANGLE_ROW, JAW_ANGLE_COLUMN], 0]),
        "face_height": float(marks[27, 1] - marks[8, 1]),
        "nose_length": float(marks[27, 1] - marks[33, 1]),
        "nose_width": 2 * float(v[t.grid[WING_ROW, WING_COLUMN], 0]),
        "nose_protrusion": float(marks[30, 2] - marks[33, 2]),
        "philtrum": float(marks[33, 1] - marks[51, 1]),
        "pupil_distance": float(_middle(balls[0])[0] - _middle(balls[1])[0]),
        "eye_width": float((outer - inner).norm()),
        "eye_size": span(balls[0], 0) / 2,
        "mouth_width": float(marks[54, 0] - marks[48, 0]),
        "ear_size": span(ear, 1),
    }


def _middle(points: Tensor) -> Tensor:
    return (points.amax(0) + points.amin(0)) / 2

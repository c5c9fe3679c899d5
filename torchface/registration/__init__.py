"""Registration: templates bent onto scans."""

from torchface.registration.landmark_files import load_scan_landmarks
from torchface.registration.nonrigid.schedule import DEFAULT_SCHEDULE, Level, Schedule, Stage
from torchface.registration.registered_mesh import hidden_parts, in_place_of, with_template_skin
from torchface.registration.scan_registration import Registration, register

__all__ = [
    "DEFAULT_SCHEDULE",
    "Level",
    "Registration",
    "Schedule",
    "Stage",
    "hidden_parts",
    "in_place_of",
    "load_scan_landmarks",
    "register",
    "with_template_skin",
]

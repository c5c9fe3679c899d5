"""Templates bent onto scans."""

from torchface.registration.in_place import in_place_of
from torchface.registration.landmark_files import load_scan_landmarks
from torchface.registration.nonrigid.schedule import DEFAULT_SCHEDULE, FULL_SCHEDULE, Level, Schedule, Stage
from torchface.registration.scan_registration import Registration, register
from torchface.registration.unseen_parts import dressed_as, hidden_parts

__all__ = [
    "DEFAULT_SCHEDULE",
    "FULL_SCHEDULE",
    "Level",
    "Registration",
    "Schedule",
    "Stage",
    "dressed_as",
    "hidden_parts",
    "in_place_of",
    "load_scan_landmarks",
    "register",
]

"""Templates bent onto scans."""

from torchface.registration.nonrigid import Registration, register
from torchface.registration.schedule import DEFAULT_SCHEDULE, FULL_SCHEDULE, Level, Schedule, Stage

__all__ = ["DEFAULT_SCHEDULE", "FULL_SCHEDULE", "Level", "Registration", "Schedule", "Stage", "register"]

"""Templates bent onto scans."""

from torchface.registration.corpus import CorpusReport, find_scans, register_corpus
from torchface.registration.corpus_record import CorpusEntry
from torchface.registration.landmark_files import load_scan_landmarks
from torchface.registration.nonrigid import Registration, register
from torchface.registration.schedule import DEFAULT_SCHEDULE, FULL_SCHEDULE, Level, Schedule, Stage

__all__ = [
    "DEFAULT_SCHEDULE",
    "FULL_SCHEDULE",
    "CorpusEntry",
    "CorpusReport",
    "Level",
    "Registration",
    "Schedule",
    "Stage",
    "find_scans",
    "load_scan_landmarks",
    "register",
    "register_corpus",
]

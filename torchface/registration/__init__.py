"""Templates bent onto scans."""

from torchface.registration.corpus.register_corpus import CorpusReport, find_scans, register_corpus
from torchface.registration.corpus.scan_record import CorpusEntry
from torchface.registration.landmark_files import load_scan_landmarks
from torchface.registration.nonrigid.schedule import DEFAULT_SCHEDULE, FULL_SCHEDULE, Level, Schedule, Stage
from torchface.registration.scan_registration import Registration, register

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

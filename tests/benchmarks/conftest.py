"""What every table is printed with: the machine and the versions that its figures hold for."""

import json
import os
import platform
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import pytest
import torch
from threadpoolctl import threadpool_limits

FIGURES = Path(__file__).resolve().parents[2] / "docs" / "figures.json"
# Of every comparison, as PyPI names them.
PEERS = (
    "numpy",
    "scipy",
    "scikit-learn",
    "opencv-contrib-python-headless",
    "onnxruntime",
    "trimesh",
    "daqp",
    "piqp",
    "osqp",
    "proxsuite",
    "quadprog",
    "eos-py",
    "nlopt",
    "dlib",
    "menpofit",
)


def pytest_report_header() -> list[str]:
    """Machine and versions of all peers, above the tables that print none of their own."""
    return machine(*PEERS)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """The peers compute on one thread, so ours does too."""
    before, opencv = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    with threadpool_limits(1):
        yield
    torch.set_num_threads(before)
    cv2.setNumThreads(opencv)


@pytest.fixture
def print_machine() -> Callable[..., None]:
    """Prints processor, cores, threads, and the versions of the packages (names on PyPI) that are compared."""
    return lambda *packages: print("", *machine(*packages), sep="\n")


@pytest.fixture
def keep_figures(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Keeps figures by name, as texts, for the README; ``docs/quote_figures.py`` puts them there."""

    def keep(**figures: str) -> None:
        kept = json.loads(FIGURES.read_text()) if FIGURES.exists() else {}
        kept[request.path.stem] = {"machine": machine()[0], **figures}
        FIGURES.write_text(json.dumps(kept, indent=2, sort_keys=True, ensure_ascii=False) + "\n")

    return keep


def machine(*packages: str) -> list[str]:
    return [
        f"{_processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads; processor time",
        ", ".join(f"{name} {_version(name)}" for name in ("torch", *packages)),
    ]


def _processor() -> str:
    listed = Path("/proc/cpuinfo")
    if listed.is_file():
        told = dict(line.split(":", 1) for line in listed.read_text().splitlines() if ":" in line)
        fields = {name.strip(): value.strip() for name, value in told.items()}
        if "model name" in fields:
            return f"{fields['model name']} (family {fields.get('cpu family')}, model {fields.get('model')})"
    return platform.processor() or platform.machine()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"

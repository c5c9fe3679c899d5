"""Nothing that torchface installs is under the GPL but what is named here, inside its wheels too.

``pip-licenses`` reads what packages say of themselves, as ``pyproject.toml`` sets it; a wheel's own libraries and the
licence texts that it carries are looked at here.
"""

import ctypes
import mmap
import re
import sys
import tomllib
from collections.abc import Iterator, Sequence
from importlib.metadata import Distribution, PackageNotFoundError, PackagePath, PathDistribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parent.parent

GPL_PARTS = {
    "av": "FFmpeg with x264 and x265 (GPL-2.0-or-later); docs/concepts/architecture.md says what a studio does",
    "bpy": "Blender, GPL-3.0-or-later: an extra, run in a process of its own; nothing imports it",
    "torch": "the licence of the tests of a library inside Kineto; the wheel holds no such code",
}
"""Packages whose wheels may hold libraries, or texts of licences, that the GPL governs, and why."""
LGPL_PARTS = {
    "opencv-contrib-python-headless": "FFmpeg without GPL parts, as shared libraries beside",
    "setuptools": "a package inside that builds setuptools; nothing of torchface imports it",
}
"""The same for texts of the LGPL."""

_GPL_LIBRARY = re.compile(
    r"(?:lib)?(?:x264|x265|xvidcore|cholmod|umfpack|spqr|fftw3\w?|gsl|readline|vidstab|rubberband|postproc|frei0r"
    r"|dvdnav|dvdread|cdio\w*|a52|mad|smbclient)[-.\d]"
)
_GPL_SYMBOLS = (b"x264_encoder_open", b"x265_encoder_open", b"cholmod_super_numeric")
_LARGEST_LIBRARY = 2**27  # bytes; above are PyTorch's own, which take seconds to read
_LIBRARY_SUFFIXES = (".so", ".dll", ".dylib", ".pyd")
_LICENCE_FILE = re.compile(r"(?i)(licen[cs]e|copying|notice|third.?party)")
_GPL_TEXT = re.compile(r"(?im)^[^\w\n]*GNU (?:AFFERO )?GENERAL PUBLIC LICENSE[^\w\n]*$")
_LGPL_TEXT = re.compile(r"(?im)^[^\w\n]*GNU (?:LESSER|LIBRARY) GENERAL PUBLIC LICENSE[^\w\n]*$")
_RUNTIME_EXCEPTION = (
    "GCC RUNTIME LIBRARY EXCEPTION"  # of libgfortran, libquadmath and libgomp: what uses them stays free
)


def installed(requirements: list[str]) -> dict[str, Distribution]:
    """What these requirements install, as far as it is installed here, by canonical name."""
    packages: dict[str, Distribution] = {}
    waiting = [Requirement(text) for text in requirements]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name in packages:
            continue
        try:
            packages[name] = distribution(requirement.name)
        except PackageNotFoundError:
            continue
        needed = map(Requirement, packages[name].requires or [])
        extras = requirement.extras or {""}
        waiting += [
            one for one in needed if not one.marker or any(one.marker.evaluate({"extra": extra}) for extra in extras)
        ]
    return packages


def gpl_libraries(files: Sequence[PackagePath]) -> Iterator[str]:
    """Libraries among a package's files that are known to be under the GPL, or that hold or call such code."""
    for file in files:
        name = file.name
        if not (name.endswith(_LIBRARY_SUFFIXES) or ".so." in name):
            continue
        path = Path(str(file.locate()))
        if _GPL_LIBRARY.match(name.lower()):
            yield name
        elif path.is_file() and 0 < path.stat().st_size < _LARGEST_LIBRARY:
            with path.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
                if any(data.find(symbol) >= 0 for symbol in _GPL_SYMBOLS):
                    yield name


def licence_texts(files: Sequence[PackagePath], heading: re.Pattern[str]) -> Iterator[str]:
    """Licences among a package's files under such a heading, those with the runtime libraries' exception left out."""
    for file in files:
        if _LICENCE_FILE.search(file.name) and file.suffix not in (".py", ".pyc", ".pyi", ".h", ".so"):
            text = Path(str(file.locate())).read_text(errors="replace")
            if heading.search(text) and _RUNTIME_EXCEPTION not in text.upper():
                yield str(file)


@pytest.fixture(scope="module")
def packages() -> dict[str, list[PackagePath]]:
    """The files of everything that the core and the extras install, by package."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    present = installed([*project["dependencies"], *(requirement for extra in extras for requirement in extra)])
    return {name: package.files or [] for name, package in present.items()}


def test_what_the_core_needs_is_here(packages: dict[str, list[PackagePath]]) -> None:
    assert {"torch", "numpy", "scipy", "opencv-contrib-python-headless", "av", "qdldl", "daqp"} <= set(packages)
    assert not {"quadprog", "cholespy"} & set(packages)


def test_no_wheel_holds_a_gpl_library_that_is_not_named(packages: dict[str, list[PackagePath]]) -> None:
    gpl = {name: libraries for name, one in packages.items() if (libraries := list(gpl_libraries(one)))}
    assert set(gpl) <= {"av", "bpy"}, gpl


def test_no_licence_text_is_the_gpl_that_is_not_named(packages: dict[str, list[PackagePath]]) -> None:
    gpl = {name: texts for name, one in packages.items() if (texts := list(licence_texts(one, _GPL_TEXT)))}
    assert set(gpl) <= set(GPL_PARTS), gpl
    lesser = {name: texts for name, one in packages.items() if (texts := list(licence_texts(one, _LGPL_TEXT)))}
    assert set(lesser) <= set(GPL_PARTS) | set(LGPL_PARTS), lesser


@pytest.mark.skipif(sys.platform != "linux", reason="looks for OpenCV's libraries where Linux wheels have them")
def test_opencvs_ffmpeg_has_no_gpl_parts(packages: dict[str, list[PackagePath]]) -> None:
    files = packages["opencv-contrib-python-headless"]
    (codecs,) = [file for file in files if file.name.startswith("libavcodec")]
    library = ctypes.CDLL(str(codecs.locate()))
    library.avcodec_license.restype = library.avcodec_configuration.restype = ctypes.c_char_p
    assert library.avcodec_license() == b"LGPL version 2.1 or later"
    assert not re.search(rb"gpl|nonfree|x26", library.avcodec_configuration())


def test_a_planted_package_is_found(tmp_path: Path) -> None:
    def planted(files: dict[str, bytes]) -> list[PackagePath]:
        records = tmp_path / "planted-1.dist-info"
        for name, data in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        (records / "RECORD").write_text("".join(f"{name},,\n" for name in files))
        return PathDistribution(records).files or []

    text, grant = "planted-1.dist-info/licenses/COPYING", b"\n   GNU GENERAL PUBLIC LICENSE\n   Version 3\n"
    package = planted(
        {text: grant, "planted.libs/libx264-d653.so.165": b"", "planted/core.so": b"..x265_encoder_open_2"}
    )
    assert list(gpl_libraries(package)) == ["libx264-d653.so.165", "core.so"]
    assert list(licence_texts(package, _GPL_TEXT)) == [text]
    assert list(licence_texts(package, _LGPL_TEXT)) == []
    free = planted({text: grant + b"GCC Runtime Library Exception", "planted/core.so": b"cholmod_analyze"})
    assert list(gpl_libraries(free)) == list(licence_texts(free, _GPL_TEXT)) == []

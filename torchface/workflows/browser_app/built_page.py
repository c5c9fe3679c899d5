"""The page's built files: those that a wheel brings, else built once by Node and kept."""

import os
import re
import shutil
import subprocess
from pathlib import Path

from torchface.errors import MissingExtraError
from torchface.files.cache_folder import cache_folder
from torchface.files.content_keys import content_key
from torchface.files.model_roots import is_checkout
from torchface.files.temporary_files import temporary_name
from torchface.progress import Progress

_PACKAGES = ("package.json", "package-lock.json")
_SOURCES = (*_PACKAGES, "index.html", "vite.config.js", "src", "public", "licences")
_IN_WHEEL = "_app"
_LEAST_NODE = (20, 19)
_SECONDS = 600
_LAST_WORDS = 400  # characters of what a program said before it failed


def built_page(progress: Progress) -> Path:
    """The folder of the page's files, as vite builds them.

    A wheel may bring it. Else Node builds it from ``export/web``, with the packages of its ``package-lock.json``, and
    it is kept in the cache under the content of these sources.
    """
    sources = page_sources()
    if sources.name == _IN_WHEEL and (sources / "dist" / "index.html").is_file():
        return sources / "dist"
    key = content_key("browser app/1", sources={name: sources / name for name in _SOURCES})
    kept = cache_folder("app") / f"page-{key[:32]}"
    if not (kept / "index.html").is_file():
        _build(sources, kept, progress)
    return kept


def page_sources() -> Path:
    """The folder that the page is built from: the checkout's, or the installed package's."""
    package = Path(__file__).resolve().parents[2]
    return package.parent / "export" / "web" if is_checkout(package.parent, package.name) else package / _IN_WHEEL


def _build(sources: Path, kept: Path, progress: Progress) -> None:
    node, npm = _node()
    packages = installed_packages(sources, npm, progress)
    progress("building the page")
    workplace, out = packages / temporary_name(kept).name, temporary_name(kept)
    try:
        workplace.mkdir()
        for name in _SOURCES:
            copy = shutil.copytree if (sources / name).is_dir() else shutil.copyfile
            copy(sources / name, workplace / name)
        vite = packages / "node_modules" / "vite" / "bin" / "vite.js"
        _run([node, str(vite), "build", "--outDir", str(out), "--logLevel", "error"], workplace)
        _settle(out, kept)
    finally:
        shutil.rmtree(workplace, ignore_errors=True)
        shutil.rmtree(out, ignore_errors=True)


def installed_packages(sources: Path, npm: str, progress: Progress) -> Path:
    """The folder with the installed ``node_modules``, once for each ``package-lock.json``."""
    key = content_key("browser app packages/1", files=[sources / name for name in _PACKAGES])
    kept = cache_folder("app") / f"packages-{key[:32]}"
    if kept.is_dir():
        return kept
    progress("installing the page's packages from npm")
    folder = temporary_name(kept)
    try:
        folder.mkdir()
        for name in _PACKAGES:
            shutil.copyfile(sources / name, folder / name)
        _run([npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel", "error"], folder)
        _settle(folder, kept)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return kept


def _node() -> tuple[str, str]:
    node, npm = shutil.which("node"), shutil.which("npm")
    wanted = f"Node {_LEAST_NODE[0]}.{_LEAST_NODE[1]} or newer with npm (https://nodejs.org), once, to build the page"
    if node is None or npm is None:
        raise MissingExtraError(f"the app: found no {'node' if node is None else 'npm'}, expected {wanted}")
    printed = subprocess.run(
        [node, "--version"], capture_output=True, text=True, check=False, timeout=60
    ).stdout.strip()
    version = re.match(r"v(\d+)\.(\d+)", printed)
    if version is None or (int(version[1]), int(version[2])) < _LEAST_NODE:
        raise MissingExtraError(f"the app: found Node {printed or 'that does not run'} ({node}), expected {wanted}")
    return node, npm


def _run(command: list[str], folder: Path) -> None:
    name = " ".join([Path(command[0]).name, *command[1:3]])
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, errors="replace", timeout=_SECONDS, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise MissingExtraError(f"the app: {name} did not end within {_SECONDS} s; is the network there?") from error
    if done.returncode != 0:
        said = (done.stderr or done.stdout).strip()[-_LAST_WORDS:]
        raise MissingExtraError(f"the app: {name} failed, expected it to build the page; it said: {said}")


def _settle(made: Path, kept: Path) -> None:
    """Gives a folder its name; another run may have made the same meanwhile."""
    try:
        os.rename(made, kept)
    except OSError:
        if not kept.is_dir():
            raise

"""A process of its own that reads a file, so that neither a crash nor its memory is this one's."""

import os
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.io.scene_processes.scene_arrays import Scene, load_scene

_FOREIGN = ("PXR_PLUGINPATH_NAME", "PXR_AR_DEFAULT_SEARCH_PATH", "PYTHONSTARTUP")
"""What would make a library of the process look elsewhere."""


def read_scene(command: Sequence[str], path: Path, reader: str, seconds: float) -> Scene:
    """The scene (``scene_arrays``) that ``command PATH FOLDER`` leaves of a file; it reports what it left out as
    ``UserWarning``."""
    with tempfile.TemporaryDirectory(prefix="torchface-scene-") as folder:
        said = run_process([*command, str(path.absolute()), folder], f"{path}", reader, seconds)
        if not any(Path(folder, name).exists() for name in ("scene.json", "refused.json")):
            raise FileFormatError(f"{path}: {reader} ended without a result{said}; expected a whole file")
        scene = load_scene(path, Path(folder))
    scene.warn_of_left_out()
    return scene


def run_process(command: Sequence[str], what: str, reader: str, seconds: float) -> str:
    """Runs a process to its end; what it said last, for an error's text."""
    environment = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    environment |= {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryFile() as output:
        try:
            done = subprocess.run(
                list(command), stdin=subprocess.DEVNULL, stdout=output, stderr=output, env=environment, timeout=seconds
            )
        except subprocess.TimeoutExpired as late:
            raise FileFormatError(f"{what}: {reader} took more than {seconds:.0f} s, expected a rig of less") from late
        except OSError as error:
            raise FileFormatError(f"{what}: {reader} cannot be started ({error})") from error
        output.seek(max(0, output.seek(0, os.SEEK_END) - 4096))
        lines = output.read().decode("utf-8", "replace").strip().splitlines()
    said = f" ({lines[-1].strip()[:200]})" if lines else ""
    if done.returncode == 0:
        return said
    how = f"status {done.returncode}"
    if done.returncode < 0:
        with suppress(ValueError):
            how = signal.Signals(-done.returncode).name
    if how in ("SIGXCPU", "SIGKILL", "SIGALRM"):
        how += ", the limit of time or memory"
    raise FileFormatError(f"{what}: {reader} ended with {how}{said}; expected a whole file that its size explains")

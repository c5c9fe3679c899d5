"""Pictures that a recipe learns from, rendered once into files of a folder: a killed run loses one file at most."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder, write_file
from torchface.progress import Progress, silent

from .spawned_processes import map_in_processes

Render = Callable[[int, int, int, Path | None], Mapping[str, Tensor]]
"""From the first picture's number, how many, the seed and ICT-FaceKit's folder to tensors by name, (M,...) each."""


@dataclass(frozen=True)
class Rendering:
    """What is rendered."""

    render: Render  # the pictures of a file; a function of a module, so that processes can import it
    method: str  # name and version; files of another one are not taken up
    prefix: str
    what: str  # it shows, in a word, for the progress
    part: int  # pictures in a file


def rendered_files(
    rendering: Rendering, folder: Path, count: int, seed: int, ict: Path | None, workers: int, progress: Progress | None
) -> list[Path]:
    """Renders what a folder does not hold yet, and gives the files; how many processes render does not change the
    pictures.

    A file that cannot be read, or has more or fewer pictures, is named in a warning and rendered again. Pictures of
    another seed or other heads lie beside each other; ``count`` is rounded up to whole files.
    """
    progress = progress or silent
    make_folder(folder)
    key = content_key(rendering.method, seed=seed, ict=None if ict is None else ict.name)[:12]
    numbers = range(-(-count // rendering.part))
    paths = [folder / f"{rendering.prefix}_{key}_{number:04d}.safetensors" for number in numbers]
    missing = [(path, number) for number, path in enumerate(paths) if not _is_whole(path, rendering.part)]
    work = partial(_render_file, rendering, seed, ict)
    ready = len(paths) - len(missing)
    for number, _ in enumerate(map_in_processes(work, missing, workers), ready + 1):
        progress(f"rendering {rendering.what}", rendering.part * number, rendering.part * len(paths))
    return paths


def _is_whole(path: Path, pictures: int) -> bool:
    if not path.is_file():
        return False
    try:
        with safe_open(path, framework="pt") as file:
            counts = {tuple(file.get_slice(name).get_shape())[:1] for name in file.keys()}  # noqa: SIM118
        if counts == {(pictures,)}:
            return True
        fault = f"found {sorted(counts)} pictures, expected {pictures}"
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        fault = str(error)
    warnings.warn(f"{path}: a damaged file of pictures ({fault}); they are rendered again", stacklevel=3)
    return False


def _render_file(rendering: Rendering, seed: int, ict: Path | None, file: tuple[Path, int]) -> None:
    path, number = file
    torch.set_num_threads(1)
    write_file(path, save(dict(rendering.render(rendering.part * number, rendering.part, seed, ict))))

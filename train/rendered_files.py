"""Pictures that a recipe learns from, rendered once into files of a folder: a killed run loses one file at most."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder, write_file
from torchface.progress import Progress, silent

Render = Callable[[int, int, int, Path | None], Mapping[str, Tensor]]
"""From the first picture's number, how many, the seed and ICT-FaceKit's folder to tensors by name, (M,...) each."""


@dataclass(frozen=True)
class Rendering:
    """What is rendered.

    Args:
        render: the pictures of a file; a function of a module, so that processes can import it.
        method: name and version; files of another one are not taken up.
        prefix: of the files' names.
        what: it shows, in a word, for the progress.
        part: pictures in a file.
    """

    render: Render
    method: str
    prefix: str
    what: str
    part: int


def rendered_files(
    rendering: Rendering, folder: Path, count: int, seed: int, ict: Path | None, workers: int, progress: Progress | None
) -> list[Path]:
    """Renders what a folder does not hold yet; how many processes render does not change the pictures.

    Args:
        rendering: what is rendered.
        folder: for the files; pictures of another seed or other heads lie beside each other there.
        count: of pictures, rounded up to whole files.
        seed: decides them.
        ict: ICT-FaceKit's ``FaceXModel``, whose heads are four in five; embedded performers alone without.
        workers: processes.
        progress: called with each step and how far it is.

    Returns:
        The files, in order.
    """
    progress = progress or silent
    make_folder(folder)
    key = content_key(rendering.method, seed=seed, ict=None if ict is None else ict.name)[:12]
    numbers = range(-(-count // rendering.part))
    paths = [folder / f"{rendering.prefix}_{key}_{number:04d}.safetensors" for number in numbers]
    missing = [(path, number) for number, path in enumerate(paths) if not path.is_file()]
    with ExitStack() as stack:
        work = partial(_render_file, rendering, seed, ict)
        done: Iterable[None] = map(work, missing)
        if workers > 1:
            # Spawned: what a process inherits of torch's threads may not survive a fork.
            pool = ProcessPoolExecutor(workers, get_context("spawn"))
            done = stack.enter_context(pool).map(work, missing)
        for number, _ in enumerate(done):
            ready = len(paths) - len(missing) + number + 1
            progress(f"rendering {rendering.what}", rendering.part * ready, rendering.part * len(paths))
    return paths


def _render_file(rendering: Rendering, seed: int, ict: Path | None, file: tuple[Path, int]) -> None:
    path, number = file
    torch.set_num_threads(1)
    write_file(path, save(dict(rendering.render(rendering.part * number, rendering.part, seed, ict))))

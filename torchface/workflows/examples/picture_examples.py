"""Examples from pictures, in the paper's order or by the files' names."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch

from torchface.capture.anybody import ExampleShapes, paper_expressions, shown_examples
from torchface.capture.anybody.examples.example_expressions import NEUTRAL
from torchface.errors import FileFormatError, NameMismatchError
from torchface.files.whole_files import numbered_order, visible_files
from torchface.io.images.image_files import IMAGE_ENDINGS, load_image
from torchface.landmarks import NoFaceError, find_landmarks
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT
from torchface.workflows.named_finders import DEFAULT_LANDMARKS, load_finder

_MOST = 256


def picture_examples(
    pictures: Sequence[Path], landmarks: str = DEFAULT_LANDMARKS, progress: Progress = silent
) -> ExampleShapes:
    """Examples of the person in pictures: files, or one folder of them.

    Where names say what they show (``neutral.png``, ``pucker.jpg``, ARKit's ``jawOpen.png``, digits before a name left
    out), any order and choice that has a neutral; otherwise the paper's 16 in its order.
    """
    files = _files(pictures)
    names = _names(files)
    finder = load_finder(landmarks, shown="photograph").finder
    faces, sides = [], []
    for number, (path, name) in enumerate(zip(files, names, strict=True)):  # pictures differ in size
        progress("finding landmarks", number, len(files))
        pixels = (load_image(path)[:3].clamp(0, 1) * 255).round().to(torch.uint8)
        try:
            faces.append(find_landmarks(pixels, finder).landmarks)
        except NoFaceError as error:
            raise NoFaceError(f"{path}: {str(error).partition(': ')[2]}; it should show {name}") from error
        sides.append(pixels.shape[1:])
    progress("finding landmarks", len(files), len(files))
    height = sides[names.index(NEUTRAL)][0]
    # The same picture in another resolution shows the same face.
    scaled = [points * (height / side[0]) for points, side in zip(faces, sides, strict=True)]
    return shown_examples(names, torch.stack(scaled))


def _files(pictures: Sequence[Path]) -> list[Path]:
    if len(pictures) == 1 and pictures[0].is_dir():
        folder = pictures[0]
        files = sorted(visible_files(folder, IMAGE_ENDINGS), key=numbered_order)
        if not files:
            raise FileFormatError(f"{folder}: found no picture, expected files ending in {', '.join(IMAGE_ENDINGS)}")
    else:
        files = list(pictures)
    if len(files) > _MOST:
        raise FileFormatError(f"examples: found {len(files)} pictures, expected at most {_MOST}")
    return files


def _names(files: Sequence[Path]) -> list[str]:
    paper = [expression.name for expression in paper_expressions()]
    spelled = {re.sub("[^a-z]", "", name.lower()): name for name in (*paper, *ARKIT)}
    named = [spelled.get(re.sub("[^a-z]", "", path.stem.lower())) for path in files]
    known = [name for name in named if name is not None]
    if not known:
        if len(files) != len(paper):
            raise NameMismatchError(
                f"examples: found {len(files)} pictures whose names say nothing ({files[0].name}, ...), expected "
                f"{len(paper)} in this order: {', '.join(paper)}; or name files by what they show"
            )
        return paper
    if len(known) < len(files):
        unknown = [path.name for path, name in zip(files, named, strict=True) if name is None]
        raise NameMismatchError(
            f"examples: found {', '.join(unknown[:5])}{', ...' if len(unknown) > 5 else ''} among files named by what "
            f"they show, expected {', '.join(paper)}, or ARKit's names"
        )
    twice = sorted({name for name in known if known.count(name) > 1})
    if twice:
        raise NameMismatchError(f"examples: found several pictures of {', '.join(twice[:5])}, expected one each")
    if NEUTRAL not in known or len(known) < 2:
        raise NameMismatchError(f"examples: found {', '.join(known[:5])}, expected {NEUTRAL} and at least one other")
    return known

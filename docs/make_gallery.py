"""Makes the pictures of ``how_to/gallery.md``, characters by code with the shapes that ``rig`` gives them."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from PIL import Image

from planted.characters import Planted, caricature, other_topology, without, write_character
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer
from torchface.workflows.rig.character_rig import PICTURE_ENDING, rig_character

IMAGES = Path(__file__).resolve().parent / "images"
WIDTH = 1000
ALONE = Planted(body=False)


def person(seed: int) -> BlendshapeRig:
    """An embedded performer."""
    return performer(draw_identities(1, torch.Generator().manual_seed(seed))[0], texture=False)


def extreme(rig: BlendshapeRig) -> BlendshapeRig:
    """Eyes twice as large, no nose, thick lips."""
    return caricature(rig, rig.vertices[rig.neutral.landmarks], eyes=1.0, lips=1.0, nose=1.0)


CHARACTERS: dict[str, tuple[Callable[[], BlendshapeRig], Planted]] = {
    "topology": (lambda: other_topology(person(3)), Planted()),
    "caricature": (lambda: other_topology(extreme(person(8))), Planted()),
    "holes": (
        lambda: without(person(15), "eyeball_left", "eyeball_right", "eye_sockets", "mouth_interior"),
        ALONE,
    ),
}


def main() -> None:
    """Writes ``images/gallery_NAME.jpg`` of each."""
    for name, (make, how) in CHARACTERS.items():
        with tempfile.TemporaryDirectory() as folder:
            bare, out = Path(folder) / "bare.glb", Path(folder) / "rigged.glb"
            write_character(bare, make().neutral, how=how)
            bare_skin = name == "holes"
            report = rig_character(bare, out, inner_mouth=bare_skin, eyes=bare_skin)
            print(name, *report.lines(), sep="\n  ")
            with Image.open(Path(folder) / f"rigged{PICTURE_ENDING}") as image:
                picture = image.convert("RGB").resize((WIDTH, WIDTH * image.height // image.width))
        picture.save(IMAGES / f"gallery_{name}.jpg", quality=88)


if __name__ == "__main__":
    main()

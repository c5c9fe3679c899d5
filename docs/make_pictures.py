"""Makes the README's pictures of the embedded performer: ``python docs/make_pictures.py`` after ``make demo``."""

from __future__ import annotations

from pathlib import Path

import torch

from torchface.registration import register
from torchface.rendering.compositing import caption, from_pillow, save_picture, sheet
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.scanner import eyes_closed, scan_head
from torchface.viz.faces import FRONT, PROFILE, THREE_QUARTER, clay_colors, face_views
from torchface.viz.registration import registration_sheet

HERE = Path(__file__).resolve().parent
SIZE = {"width": 232, "height": 290}
POSES = {
    "eyeBlink": ("eyeBlinkLeft", "eyeBlinkRight"),
    "jawOpen": ("jawOpen",),
    "mouthSmile": ("mouthSmileLeft", "mouthSmileRight"),
    "mouthPucker": ("mouthPucker",),
    "browInnerUp, eyeWide": ("browInnerUp", "browOuterUpLeft", "browOuterUpRight", "eyeWideLeft", "eyeWideRight"),
    "noseSneer, browDown": ("noseSneerLeft", "noseSneerRight", "browDownLeft", "browDownRight"),
}


def performer_sheet() -> torch.Tensor:
    """Three views and clay, six expressions, six other heads."""
    rig = performer()
    views = [caption(face_views(rig.neutral, (yaw,), **SIZE), "neutral") for yaw in (FRONT, THREE_QUARTER, PROFILE)]
    views += [
        caption(face_views(rig.neutral, (yaw,), clay_colors(rig.neutral), **SIZE), "form")
        for yaw in (FRONT, THREE_QUARTER, PROFILE)
    ]
    expressions = []
    for title, names in POSES.items():
        weights = mapping(ARKIT, rig.names)[:, [ARKIT.index(name) for name in names]].sum(1)
        posed = rig.neutral.with_vertices(rig(weights[None])[0])
        expressions.append(caption(face_views(posed, (20.0,), framed_by=rig.neutral, **SIZE), title))
    heads = [
        caption(face_views(performer(identity).neutral, (20.0,), **SIZE), f"identity {i + 1}")
        for i, identity in enumerate(draw_identities(6, torch.Generator().manual_seed(3)))
    ]
    return sheet([*views, *expressions, *heads], 6)


def registration_picture() -> torch.Tensor:
    """Another head's raw scan, the performer bent onto it, and how far off it is."""
    identity = draw_identities(1, torch.Generator().manual_seed(11))[0]
    scan = scan_head(eyes_closed(performer(identity)), seed=50)
    template = eyes_closed(performer())
    found = register(template, scan.mesh, (template.landmarks, scan.ibug), texture_size=2048)
    return registration_sheet(scan.mesh, found, maximum=0.5)


def main() -> None:
    from PIL import Image

    save_picture(performer_sheet(), HERE / "images" / "performer.jpg")
    save_picture(registration_picture(), HERE / "images" / "registration.jpg")
    with Image.open(HERE.parent / "out" / "demo" / "frame_1.png") as image:
        save_picture(from_pillow(image), HERE / "images" / "demo.jpg")


if __name__ == "__main__":
    main()

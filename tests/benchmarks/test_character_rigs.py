"""Claim: a character whose shapes are stripped gets them back nearer to its own than by nearest vertices.

Characters with a body, hair and a skeleton: a performer by code of another topology, the same as a caricature (eyes and
lips larger, nose flatter), ICT-FaceKit's head, the same as a caricature, and Face Cap's head as three.js ships it. The
template is the embedded performer. By nearest vertices each vertex moves as the template's nearest one, after the same
landmarks were aligned. Cosine and relative error are those of all vertices of parts that the character's own
shapes move.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from character_trials import Trial, rigged, trial

from planted.characters import caricature, other_topology
from torchface.io import load_rig
from torchface.rig import BlendshapeRig
from torchface.synthetic import draw_identities, performer

SECONDS, FINDING = 60.0, 10.0  # on two quiet cores


def person() -> BlendshapeRig:
    return performer(draw_identities(1, torch.Generator().manual_seed(3))[0], texture=False)


def warped(rig: BlendshapeRig) -> BlendshapeRig:
    return caricature(rig, rig.vertices[rig.neutral.landmarks])


TRIALS: dict[str, Callable[[Path], BlendshapeRig]] = {
    "performer": lambda _: other_topology(person()),
    "performer, caricature": lambda _: other_topology(warped(person())),
    "ICT": lambda data: load_rig(data),
    "ICT, caricature": lambda data: warped(load_rig(data)),
}


@pytest.mark.bench
@pytest.mark.parametrize("name", [*TRIALS, "Face Cap"])
def test_shapes_come_back_nearer_than_by_nearest_vertices(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if name == "Face Cap":
        data: Path = request.getfixturevalue("ict_folder").parents[1]
        one = Trial(name, data / "characters" / "facecap.glb")
    else:
        source = request.getfixturevalue("ict_folder") if name.startswith("ICT") else Path()
        one = trial(tmp_path, name, TRIALS[name](source))
    report, made, nearest = rigged(one, tmp_path)
    shapes = (made.cosine.median(), made.error.median(), nearest.cosine.median(), nearest.error.median())
    seconds = f"{report.seconds[0]:.1f} s to find the face, {report.seconds[1]:.1f} in all"
    print(
        f"\n{name}: cosine {shapes[0]:.3f}, error {shapes[1]:.3f}; nearest {shapes[2]:.3f}, {shapes[3]:.3f}; {seconds}"
    )
    rows = zip(made.names, made.cosine, made.error, nearest.cosine, nearest.error, strict=True)
    for shape, *values in rows:
        print(f"  {shape:22s}" + "".join(f"{float(value):7.3f}" for value in values))
    assert shapes[0] > shapes[2]
    assert shapes[1] < shapes[3]

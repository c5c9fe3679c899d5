"""Claim: a character whose shapes are stripped gets them back nearer to its own than by nearest vertices.

Characters with a body, hair and a skeleton: a performer by code of another topology, the same as a caricature (eyes and
lips larger, nose flatter), as an extreme one (eyes twice as large, no nose), of 4,000 triangles in centimetres on its
back, without eyes and mouth inside, ICT-FaceKit's head and caricatures of it, and Face Cap's head as three.js ships
it. The template is the embedded performer. By nearest vertices each vertex moves as the template's nearest one, after
the same landmarks were aligned. Cosine and relative error are those of all vertices of parts that the character's own
shapes move.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from character_trials import Trial, rigged, trial

from planted.characters import UPRIGHT, Planted, caricature, decimated, other_topology, without
from torchface import BlendshapeRig, load_rig
from torchface.geometry.rotations import rotation_matrix
from torchface.synthetic import draw_identities, performer


def person() -> BlendshapeRig:
    return performer(draw_identities(1, torch.Generator().manual_seed(3))[0], texture=False)


def warped(rig: BlendshapeRig) -> BlendshapeRig:
    return caricature(rig, rig.vertices[rig.neutral.landmarks])


def extreme(rig: BlendshapeRig) -> BlendshapeRig:
    """Eyes twice as large, no nose, thick lips."""
    return caricature(rig, rig.vertices[rig.neutral.landmarks], eyes=1.0, lips=1.0, nose=1.0)


ON_ITS_BACK = Planted(rotation_matrix(torch.tensor([-1.57, 0.0, 0.3], dtype=torch.float64)), units=100.0)
Z_UP = Planted(rotation_matrix(torch.tensor([1.57, 0.0, 0.0], dtype=torch.float64)))
TRIALS: dict[str, tuple[Callable[[Path], BlendshapeRig], Planted]] = {
    "performer": (lambda _: other_topology(person()), UPRIGHT),
    "performer, caricature": (lambda _: other_topology(warped(person())), UPRIGHT),
    "performer, extreme caricature": (lambda _: other_topology(extreme(person())), UPRIGHT),
    "performer, 4,000 triangles, centimetres, on its back": (lambda _: decimated(person(), 4000), ON_ITS_BACK),
    "performer, no eyes, no mouth inside": (
        lambda _: without(person(), "eyeball_left", "eyeball_right", "eye_sockets", "mouth_interior"),
        UPRIGHT,
    ),
    "ICT": (load_rig, Z_UP),
    "ICT, caricature": (lambda data: warped(load_rig(data)), UPRIGHT),
    "ICT, extreme caricature": (lambda data: extreme(load_rig(data)), UPRIGHT),
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
        make, how = TRIALS[name]
        one = trial(tmp_path, name, make(source), how)
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

"""Time and memory of training grow in proportion to what is learned from: 10,000 heads and people, 5,000 takes.

Each count is trained in a process of its own, so that its peak resident memory, PyTorch included, is its own.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torchface.io.meshes.mesh_sequence import MeshSequenceWriter
from torchface.modeling import MorphableModel
from torchface.synthetic import draw_identities, neutral_head, performer

pytestmark = pytest.mark.slow

COUNTS, TAKES, PICTURES = (5000, 7500, 10000), (1250, 2500, 5000), (3600, 7200, 14400)
COMPONENTS, FRAMES, STEPS, BATCH = 20, 200, 12, 16
EXPRESSIONS = ("jawOpen", "mouthSmileLeft")
Found = dict[str, float]

MEASURE = """
import json, resource, sys, time
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
def tell(begin, start, passes=1):
    found = {"seconds": time.process_time() - start, "passes": passes, "gib": peak(), "own": peak() - begin}
    print(json.dumps(found))
"""
HEADS = """
from torchface.io import MeshSequence
from torchface.modeling import MorphableModel
from train.sample_views import SampleRange
begin, start, passes = peak(), time.process_time(), []
MorphableModel.fit(SampleRange(MeshSequence(sys.argv[2]), 0, int(sys.argv[1])), int(sys.argv[3]),
             progress=lambda step, done, total: passes.append(done / total))
tell(begin, start, round(30 * passes[-1]))
"""
PEOPLE = """
from pathlib import Path
import torch
from safetensors.torch import load_file
from torchface import BlendshapeRig
from torchface.progress import silent
from torchface.synthetic import neutral_head, draw_identities
from train.expression import Settings, fit
from train.people_samples import gather
bank, template = load_file(sys.argv[2]), neutral_head(draw_identities(1, torch.Generator().manual_seed(0))[0])
names = sys.argv[4:]
def person(number):
    generator = torch.Generator().manual_seed(number)
    share = torch.randn(len(bank["modes"]), generator=generator)
    points = bank["mean"] + torch.einsum("k,kpc->pc", share, bank["modes"]).unflatten(0, (len(names) + 1, -1))
    points = points + 0.02 * torch.randn(points.shape, generator=generator)
    return BlendshapeRig(template.with_vertices(points[0]), points[1:], names)
count, passes = int(sys.argv[1]), [0]
begin, start = peak(), time.process_time()
people = gather([str(i) for i in range(count)], person, str, Path(sys.argv[3]), "drawn", silent)
def counted(step, done=0, total=0):
    passes.append(30 * done / total if total else 0)
fit(people, Settings(), counted)
ends = [a for a, b in zip(passes, [*passes[1:], 0]) if b < a]
tell(begin, start, sum(ends))
"""
PRIORS = """
from pathlib import Path
from train.priors import Settings, train
begin, start = peak(), time.process_time()
train(Settings(performances=int(sys.argv[1]) + 10, frames=int(sys.argv[3]), held_out=10, window=4, strength=0.15,
               out=Path(sys.argv[2]) / "prior"))
tell(begin, start)
"""
NETWORK = """
from pathlib import Path
from torchface.landmarks import LandmarkNetwork, NetworkSettings
from train.face_pictures import StoredPictures
pictures = StoredPictures(sorted(Path(sys.argv[2]).glob("*.safetensors")), int(sys.argv[1]))
begin, start = peak(), time.process_time()
LandmarkNetwork.fit(pictures, None, NetworkSettings(steps=int(sys.argv[3]), batch=int(sys.argv[4]), workers=0))
tell(begin, start)
"""


EYES = """
from pathlib import Path
from torchface.landmarks.images.networks.eye_network import EyeNetwork
from torchface.landmarks.images.networks.eye_training import EyeSettings
from train.eye_pictures import StoredEyePictures
pictures = StoredEyePictures(sorted(Path(sys.argv[2]).glob("*.safetensors")), 0, int(sys.argv[1]))
begin, start = peak(), time.process_time()
EyeNetwork.fit(pictures, None, EyeSettings(steps=int(sys.argv[3]), batch=int(sys.argv[4])))
tell(begin, start)
"""
SCENES = """
from functools import partial
from pathlib import Path
from torchface.landmarks import BoxNetwork, BoxTrainingSettings
from train.rendered_people.face_scenes import face_scene
from train.face_pictures import StoredCutOuts
people = StoredCutOuts(sorted(Path(sys.argv[2]).glob("*.safetensors")), 0, int(sys.argv[1]))
begin, start = peak(), time.process_time()
BoxNetwork.fit(partial(face_scene, people), BoxTrainingSettings(int(sys.argv[3]), int(sys.argv[4])))
tell(begin, start)
"""


def trained(what: str, script: str, counts: Sequence[int], *words: object) -> list[Found]:
    """What training took, count by count."""
    told: list[Found] = []
    for count in counts:
        run = [sys.executable, "-c", MEASURE + script, str(count), *(str(word) for word in words)]
        told.append(json.loads(subprocess.run(run, capture_output=True, text=True, check=True).stdout.splitlines()[-1]))
        found = told[-1]
        print(
            f"\n{count} {what}: {found['seconds']:.1f} processor seconds, {found['passes']:.0f} passes, "
            f"peak {found['gib']:.2f} GiB, of which {found['own']:.2f} the training's"
        )
    return told


def check_memory(told: Sequence[Found]) -> None:
    """Two gigabytes with PyTorch, and hardly more for the largest set than for the smallest."""
    assert max(found["gib"] for found in told) < 2e9 / 2**30
    assert told[-1]["own"] < 1.3 * told[0]["own"] + 0.1


@pytest.fixture(scope="module")
def heads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Heads of the performer's topology, drawn from a model of forty of them, with noise."""
    path = tmp_path_factory.mktemp("heads") / "heads.safetensors"
    generator = torch.Generator().manual_seed(0)
    people = [neutral_head(identity, texture=False) for identity in draw_identities(40, generator)]
    model = MorphableModel.fit(torch.stack([mesh.vertices for mesh in people]))
    size = people[0].vertices.shape
    with MeshSequenceWriter(path, COUNTS[-1], size[0], people[0].faces) as writer:
        while writer.done < COUNTS[-1]:
            drawn = model(torch.randn(500, model.count, generator=generator))
            writer.append(drawn + 0.05 * torch.randn(500, *size, generator=generator))
    return path


def test_heads(heads: Path) -> None:
    told = trained("heads", HEADS, COUNTS, heads, COMPONENTS)
    check_memory(told)
    # A pass costs the same for each head; how many are made depends on the spectrum, not on the heads.
    per_head = [found["seconds"] / count / (found["passes"] + 1) for found, count in zip(told, COUNTS, strict=True)]
    assert max(per_head) < 1.4 * min(per_head)


@pytest.fixture(scope="module")
def bank(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In what forty performers, with two expressions each, differ."""
    path = tmp_path_factory.mktemp("people") / "bank.safetensors"
    identities = draw_identities(40, torch.Generator().manual_seed(0))
    rigs = [performer(identity, texture=False).select(EXPRESSIONS) for identity in identities]
    points = torch.stack([torch.cat([rig.vertices[None], rig.deltas]) for rig in rigs])  # (M,1+N,V,3)
    model = MorphableModel.fit(points.flatten(1, 2))
    modes = model.components * model.standard_deviations[:, None, None]
    save_file({"mean": points.mean(0), "modes": modes.float().contiguous()}, path)
    return path


def test_people_with_expressions(bank: Path, tmp_path: Path) -> None:
    """Each count takes up the people that the one before it has gathered, so files are read as well as made."""
    told = trained("people", PEOPLE, COUNTS, bank, tmp_path, *EXPRESSIONS)
    check_memory(told)
    # Four passes lay neutrals on each other, one finds what moves, one solves; the others are counted.
    per_person = [found["seconds"] / count / (found["passes"] + 6) for found, count in zip(told, COUNTS, strict=True)]
    assert max(per_person) < 1.4 * min(per_person)


def test_takes(tmp_path: Path) -> None:
    told = trained("takes", PRIORS, TAKES, tmp_path, FRAMES)
    check_memory(told)
    # What is learned from frames drawn from all, hyperparameters and noise, takes the same for any number of takes.
    seconds = [found["seconds"] for found in told]
    first, second = ((seconds[i + 1] - seconds[i]) / (TAKES[i + 1] - TAKES[i]) for i in range(2))
    assert second < 1.4 * first


def repeated(folder: Path, rows: dict[str, torch.Tensor]) -> Path:
    """Rows of a file under so many names that there are enough of them."""
    folder.mkdir()
    first = folder / "0000.safetensors"
    save_file(rows, first)
    for number in range(1, PICTURES[-1] // len(rows["rgba"])):
        os.link(first, folder / f"{number:04}.safetensors")
    return folder


def test_pictures(tmp_path: Path) -> None:
    """Files of the size that the recipes render, one of them under many names."""
    generator = torch.Generator().manual_seed(0)
    landmarks = 40 + 110 * torch.rand(240, 68, 2, generator=generator)
    rgba = torch.randint(256, (240, 4, 192, 192), generator=generator, dtype=torch.uint8)
    visible = torch.ones(240, 68, dtype=torch.bool)
    faces = repeated(tmp_path / "faces", {"rgba": rgba, "landmarks": landmarks, "visible": visible})
    labels = {"openness": 2, "bare": 2}
    eyes = {name: torch.rand(240, size, generator=generator) for name, size in labels.items()}
    eyes |= {name: 160 * torch.rand(240, 2, 2, generator=generator) for name in ("iris", "gaze")}
    eyes |= {
        "rgba": rgba[:, :, :64, :160].contiguous(),
        "landmarks": landmarks,
        "visible": visible[:, :12].contiguous(),
    }
    for what, script, folder in (
        ("pictures", NETWORK, faces),
        ("eyes", EYES, repeated(tmp_path / "eyes", eyes)),
        ("people of scenes", SCENES, faces),
    ):
        told = trained(what, script, PICTURES, folder, STEPS, BATCH)
        check_memory(told)
        assert told[-1]["seconds"] < 1.4 * told[0]["seconds"]

"""Time and memory of a head model's training grow in proportion to the number of heads, to 10,000 of them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchface.io.meshes.mesh_sequence import MeshSequenceWriter
from torchface.modeling import MorphableModel
from torchface.synthetic import draw_identities, neutral_head

pytestmark = pytest.mark.slow

COUNTS = (5000, 7500, 10000)
COMPONENTS = 20
FIT = """
import json, resource, sys, time
from torchface.geometry.sample_batches import SampleRange
from torchface.io import MeshSequence
from torchface.modeling import fit_sequence
begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
start = time.process_time()
passes = []
fit_sequence(SampleRange(MeshSequence(sys.argv[1]), 0, int(sys.argv[2])), int(sys.argv[3]),
             progress=lambda step, done, total: passes.append(done / total))
spent = time.process_time() - start
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
own = (peak - begin) / 2**20
print(json.dumps({"seconds": spent, "passes": round(30 * passes[-1]), "gib": peak / 2**20, "own": own}))
"""


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


def test_time_and_memory_are_linear_in_the_number_of_heads(heads: Path, tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    told = []
    for count in COUNTS:
        words = [sys.executable, "-c", FIT, str(heads), str(count), str(COMPONENTS)]
        found = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
        told.append(found)
        print(
            f"\n{count} heads: {found['seconds']:.1f} processor seconds, {found['passes']} passes, "
            f"peak {found['gib']:.2f} GiB, of which {found['own']:.2f} the fit's"
        )
    figure = Figure(figsize=(7, 3))
    for place, (name, key) in enumerate((("processor seconds", "seconds"), ("peak GiB", "gib")), 1):
        axes = figure.add_subplot(1, 2, place)
        axes.plot(COUNTS, [found[key] for found in told], "o-")
        axes.set(xlabel="heads", ylabel=name, ylim=(0, None))
    figure.savefig(tmp_path / "growth.png")
    print(tmp_path / "growth.png")
    # A pass costs the same for each head; how many are made depends on the spectrum, not on the heads.
    per_head = [found["seconds"] / count / (found["passes"] + 1) for found, count in zip(told, COUNTS, strict=True)]
    assert max(per_head) < 1.4 * min(per_head)
    assert max(found["gib"] for found in told) < 2
    assert told[-1]["own"] < 1.3 * told[0]["own"] + 0.1

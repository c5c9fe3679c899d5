"""Morphable models: speed and agreement beside numpy's ``eigh`` of the Gram matrix, which is the same method, and
scikit-learn's solvers; ten thousand samples from disk in bounded memory.

``$TORCHFACE_BENCH_SAMPLES`` sets how many samples lie on disk (10,000 if absent: 1.1 GB of file, some minutes).
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from sklearn.decomposition import PCA
from torch import Tensor

from torchface.io import MeshSequence, MeshSequenceWriter, load_identity_modes
from torchface.modeling import MorphableModel

SAMPLES = int(os.environ.get("TORCHFACE_BENCH_SAMPLES", "10000"))
VERTICES, COMPONENTS = 9409, 200

FIT = """
import json, resource, sys, time
from torchface.io.meshes.mesh_sequence import MeshSequence
from torchface.modeling import MorphableModel
from safetensors.torch import save_file

path, checkpoint, out = sys.argv[1:4]
begin, clock, limit = time.perf_counter(), time.process_time(), int(sys.argv[4])
seen = []

def progress(step, done, total):
    seen.append(done)
    print(json.dumps({"done": done, "total": total}), flush=True)

model = MorphableModel.fit(MeshSequence(path), limit, checkpoint, progress)
save_file({"deviations": model.standard_deviations, "components": model.components[:5]}, out)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps({"gib": peak, "wall": time.perf_counter() - begin, "cpu": time.process_time() - clock}), flush=True)
"""


def gram_components(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (M-1,) and components (M-1,D) of samples (M,D) as one writes it in five lines of numpy."""
    centred = samples - samples.mean(0)
    values, vectors = np.linalg.eigh(centred @ centred.T)
    values, vectors = values[:0:-1], vectors[:, :0:-1]
    return np.sqrt(values / (len(samples) - 1)), (vectors / np.sqrt(values)).T @ centred


def scikit_components(samples: np.ndarray, solver: str) -> tuple[np.ndarray, np.ndarray]:
    found = PCA(len(samples) - 1, svd_solver=solver, random_state=0).fit(samples)
    return np.sqrt(found.explained_variance_), found.components_


def our_components(samples: Tensor) -> tuple[np.ndarray, np.ndarray]:
    model = MorphableModel.fit(samples)
    return model.standard_deviations.numpy(), model.components.flatten(1).numpy()


@pytest.mark.real
def test_as_exact_as_float64_and_as_fast_as_float32(
    ict_folder: Path, one_thread: None, print_machine: Callable[..., None]
) -> None:
    """200 heads of 26,719 vertices: ICT-FaceKit's modes, and noise so that all 199 components are there."""
    modes = load_identity_modes(ict_folder)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(200, len(modes.names), generator=generator)
    heads = torch.stack([modes.head(row).vertices for row in drawn])
    heads += 0.1 * torch.randn(heads.shape, generator=generator)
    flat = heads.flatten(1).numpy()
    ways: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
        "torchface": lambda: our_components(heads),
        "numpy eigh of Gram, float32": lambda: gram_components(flat),
        "numpy eigh of Gram, float64": lambda: gram_components(flat.astype(np.float64)),
        "scikit-learn full, float32": lambda: scikit_components(flat, "full"),
        "scikit-learn full, float64": lambda: scikit_components(flat.astype(np.float64), "full"),
        "scikit-learn randomized, float32": lambda: scikit_components(flat, "randomized"),
    }
    seconds, results = dict.fromkeys(ways, float("inf")), {}
    for repeat in range(3):
        for name, way in ways.items():
            if repeat and "scikit" in name:
                continue  # far slower
            begin = time.process_time()
            results[name] = way()
            seconds[name] = min(seconds[name], time.process_time() - begin)
    exact = results["scikit-learn full, float64"]
    gaps, cosines = {}, {}
    for name, (deviations, components) in results.items():
        gaps[name] = float(np.abs(deviations / exact[0] - 1).max())
        # Only where two deviations are well apart does each have a direction of its own: the twenty modes.
        cosines[name] = float(np.abs((components[:20].astype(np.float64) * exact[1][:20]).sum(1)).min())
    print_machine("numpy", "scikit-learn")
    print("200 samples x 26,719 vertices, all 199 components; deviations and modes beside scikit-learn's in float64")
    print(f"{'':>34} {'seconds':>8} {'ratio':>6} {'worst deviation':>16} {'1 - least cosine':>17}")
    for name, took in seconds.items():
        ratio = took / seconds["torchface"]
        print(f"{name:>34} {took:8.2f} {ratio:6.2f} {gaps[name]:16.1e} {1 - cosines[name]:17.1e}")
    assert gaps["torchface"] <= 1e-7
    assert cosines["torchface"] > 1 - 1e-6
    assert seconds["torchface"] <= 0.8 * seconds["numpy eigh of Gram, float64"]
    assert seconds["torchface"] <= 3.5 * seconds["numpy eigh of Gram, float32"]
    assert seconds["scikit-learn full, float32"] >= 5 * seconds["torchface"]


@pytest.fixture(scope="module")
def on_disk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("corpus") / "heads.safetensors"
    generator = torch.Generator().manual_seed(0)
    basis = 2 * torch.randn(300, 3 * VERTICES, generator=generator) * 0.98 ** torch.arange(300)[:, None]
    with MeshSequenceWriter(path, SAMPLES, VERTICES, torch.tensor([[0, 1, 2]])) as writer:
        while writer.done < SAMPLES:
            count = min(500, SAMPLES - writer.done)
            mixed = torch.randn(count, 300, generator=generator) @ basis
            noise = 0.05 * torch.randn(count, 3 * VERTICES, generator=generator)
            writer.append((100 + mixed + noise).reshape(count, VERTICES, 3))
    return path


def test_ten_thousand_from_disk_within_four_gigabytes_killed_once(on_disk: Path, tmp_path: Path) -> None:
    words = [sys.executable, "-c", FIT, str(on_disk), str(tmp_path / "check"), str(tmp_path / "state")]
    words.append(str(min(COMPONENTS, SAMPLES // 4)))
    killed_at = 0
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as child:
        for line in child.stdout:
            step = json.loads(line)
            killed_at = step["done"]
            if killed_at > 0.08 * step["total"]:  # of 30 passes, which are the most that may be needed
                child.send_signal(signal.SIGKILL)
                break
    kept = len(list((tmp_path / "check").glob("*.safetensors")))
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout.splitlines()[-1])
    print(f"\n{SAMPLES} samples x {VERTICES} vertices, {on_disk.stat().st_size / 2**30:.2f} GiB on disk")
    print(f"killed after {killed_at} blocks, {kept} basis kept; then")
    print(f"peak {told['gib']:.2f} GiB, {told['wall']:.0f} s, {told['cpu']:.0f} processor seconds")
    assert told["gib"] < 4
    assert kept > 0
    # A few hundred of the samples tell the same spread, as far as so few can.
    few = MorphableModel.fit(MeshSequence(on_disk).read(0, min(600, SAMPLES)), 5)
    found = load_file(tmp_path / "state")
    assert torch.allclose(found["deviations"][:5], few.standard_deviations, rtol=0.15)

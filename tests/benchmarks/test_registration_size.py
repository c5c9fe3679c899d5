"""How registration grows with the size of template and scan; each size in a process of its own, for its memory."""

import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from torchface.rendering.compositing import from_figure, save_rendered_image

CHILD = """
import json, resource, sys, time
import numpy as np, torch, trimesh
from torchface.io import load_identity_modes
from torchface.mesh import Mesh, submesh
from torchface.registration import register

folder, part, wanted = sys.argv[1], sys.argv[2], int(sys.argv[3])
modes = load_identity_modes(folder, 5)
regions = modes.neutral.annotations.regions
head = modes.head(torch.randn(5, generator=torch.Generator().manual_seed(0)))
skin = submesh(head, regions["face"] | regions["head_and_neck"]).mesh
template = submesh(modes.neutral, regions["face"]).mesh if part == "face" else modes.neutral
surface = trimesh.Trimesh(skin.vertices.double().numpy(), skin.faces.numpy(), process=False)
while len(surface.vertices) < wanted:
    surface = surface.subdivide()
faces = torch.tensor(np.asarray(surface.faces), dtype=torch.int64)
vertices = torch.tensor(np.asarray(surface.vertices))
if len(vertices) > 1.2 * wanted:  # every so many'th vertex, joined to its neighbours' nearest kept one
    keep = np.linspace(0, len(vertices) - 1, wanted).astype(int)
    from scipy.spatial import cKDTree
    nearest = torch.from_numpy(cKDTree(vertices.numpy()[keep]).query(vertices.numpy())[1])
    faces = nearest[faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    vertices = vertices[torch.from_numpy(keep)]
scan = Mesh(vertices, faces)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
landmarks = (template.landmarks, head.vertices[modes.neutral.landmarks].double())
times = []
for _ in range(2):
    begin, processor = time.perf_counter(), time.process_time()
    result = register(template, scan, landmarks)
    times.append((time.perf_counter() - begin, time.process_time() - processor))
face_count = 9409
print(json.dumps({
    "template": len(template.vertices), "scan": len(vertices), "seconds": min(times)[0],
    "processor": min(t[1] for t in times),
    "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "before": before,
    "true": float((result.mesh.vertices[:face_count] - head.vertices[:face_count]).norm(dim=1).mean()),
    "surface": float(result.distance[:face_count].mean()),
}))
"""
SIZES = [(part, count) for part in ("face", "whole") for count in (11_000, 40_000, 100_000)]


@pytest.mark.real
def test_time_and_memory_up_to_large_meshes(ict_folder: Path) -> None:
    rows = []
    for part, scan in SIZES:
        child = subprocess.run(
            [sys.executable, "-c", CHILD, str(ict_folder), part, str(scan)],
            capture_output=True,
            text=True,
            check=True,
            timeout=900,
        )
        rows.append(json.loads(child.stdout.splitlines()[-1]))
    print(f"\n{'template':>9}{'scan':>9}{'s':>8}{'processor s':>13}{'MB at most':>12}{'true mm':>9}{'surface mm':>12}")
    for row in rows:
        print(
            f"{row['template']:9}{row['scan']:9}{row['seconds']:8.2f}{row['processor']:13.2f}{row['peak']:12.0f}{row['true']:9.3f}"
            f"{row['surface']:12.3f}"
        )
    figure, axes = plt.subplots(figsize=(6, 4))
    for template in sorted({row["template"] for row in rows}):
        mine = [row for row in rows if row["template"] == template]
        axes.plot([r["scan"] for r in mine], [r["seconds"] for r in mine], "o-", label=f"{template:,} vertices")
    axes.set(xlabel="vertices of the scan", ylabel="seconds", ylim=(0, None))
    axes.legend(title="template")
    save_rendered_image(from_figure(figure), Path(__file__).parents[2] / "out" / "registration" / "time.png")
    plt.close(figure)
    assert max(row["peak"] for row in rows) < 2048
    growth = np.polyfit(np.log([r["scan"] for r in rows[:3]]), np.log([r["seconds"] for r in rows[:3]]), 1)[0]
    assert growth < 1.2  # no worse than in proportion to the scan

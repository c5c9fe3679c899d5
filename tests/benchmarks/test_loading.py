"""Loading a real rig: ICT-FaceKit's 74 files, against trimesh on the same files, and the ``.glb`` it becomes."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import trimesh

from torchface.io import load_identity_modes, load_rig, save_rig

PEER_FILES = 2


def seconds(work: Callable[[], object]) -> float:
    """The quickest of three runs."""
    taken = []
    for _ in range(3):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return min(taken)


@pytest.mark.real
def test_seventy_four_files_load_faster_than_with_trimesh(ict_folder: Path, tmp_path: Path) -> None:
    rig = load_rig(ict_folder)
    paths = [ict_folder / f"{name}.obj" for name in rig.names[:PEER_FILES]]
    ours = seconds(lambda: (load_rig(ict_folder), load_identity_modes(ict_folder)))
    theirs = seconds(
        lambda: [trimesh.load(path, process=False, maintain_order=True, skip_materials=True) for path in paths]
    )
    files = 1 + len(rig.names) + 20
    print(f"\n{'':34}{'total s':>10}{'ms a file':>11}")
    print(f"{f'torchface, {files} files':34}{ours:10.2f}{1000 * ours / files:11.1f}")
    print(f"{f'trimesh, {PEER_FILES} files':34}{theirs:10.2f}{1000 * theirs / PEER_FILES:11.1f}")
    path = tmp_path / "rig.glb"
    for name, piece in (("head", rig), ("face", rig.part(rig.neutral.annotations.regions["face"]))):
        written = seconds(partial(save_rig, piece, path))
        read = seconds(partial(load_rig, path))
        megabytes, dense = path.stat().st_size / 2**20, piece.deltas.numel() * 4 / 2**20
        print(f"{name}: .glb of {megabytes:.1f} MB ({dense:.1f} MB of deltas), {written:.2f} s out, {read:.2f} s in")
    assert theirs / PEER_FILES > 3 * ours / files

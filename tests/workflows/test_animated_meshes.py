"""What a folder holds is one animation, a mesh a frame, or several."""

from pathlib import Path

import torch

from torchface import BlendshapeRig, Take, Track, save_animation, save_mesh, save_rig, save_take
from torchface.workflows.animated_meshes import is_animation


def test_meshes_are_frames_and_scenes_that_move_are_not(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    for folder in ("none", "frames", "scenes", "still", "beside"):
        (tmp_path / folder).mkdir()
    take = Take(30.0, weights=Track(dome_rig.names, torch.rand(3, len(dome_rig.names), 1)))
    for number in range(2):
        save_mesh(dome_rig.neutral, tmp_path / "frames" / f"{number}.ply")
        save_rig(dome_rig, tmp_path / "still" / f"{number}.glb")
    save_take(take, tmp_path / "frames" / "weights.csv")
    (tmp_path / "scenes" / "a_damaged.glb").write_bytes(b"glTF")
    for name in ("calm", "loud"):
        save_animation(dome_rig, take, tmp_path / "scenes" / f"{name}.glb")
    save_mesh(dome_rig.neutral, tmp_path / "scenes" / "head.ply")
    save_mesh(dome_rig.neutral, tmp_path / "beside" / "head.ply")
    assert is_animation(tmp_path / "beside")  # one frame
    save_take(take, tmp_path / "beside" / "calm.csv")
    found = {folder.name: is_animation(folder) for folder in tmp_path.iterdir()}
    assert found == {"none": False, "frames": True, "scenes": False, "still": True, "beside": False}

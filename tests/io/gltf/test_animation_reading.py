"""Weights that an animated file plays are those that were written, at the rate that was meant."""

from pathlib import Path

import numpy as np
import pytest
import torch
from mutation import check_reader
from rig_samples import sheet_rig, sheet_take

from planted.glb_files import packed, rewrite, unpacked
from torchface import Take, Track, save_animation, save_rig
from torchface.errors import FileFormatError
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.io.gltf.gltf_document import read_document
from torchface.io.gltf.performance_animation import Performance, performed_glb


def edited(path: Path, change: dict, before: tuple[dict, ...] = (), after: tuple[dict, ...] = ()) -> Path:
    """The file with members of its one animation changed, and others before and after it."""

    def animate(root: dict) -> None:
        root["animations"][0].update(change)
        root["animations"] = [*before, *root["animations"], *after]

    return rewrite(path, animate)


@pytest.mark.parametrize("fps", [24.0, 30000 / 1001, 60.0, 120.0, 23.7])
def test_weights_and_rate_come_back(fps: float, tmp_path: Path) -> None:
    rig = sheet_rig()
    weights = torch.rand(700, len(rig.names), 1, generator=torch.Generator().manual_seed(0))
    save_animation(rig, Take(fps, weights=Track(rig.names, weights)), tmp_path / "take.glb")
    found = read_gltf_weights(tmp_path / "take.glb")
    assert found.fps == pytest.approx(fps, rel=1e-6)
    assert found.weights.names == rig.names
    assert torch.equal(found.weights.values, weights)


def test_the_first_animation_that_moves_shapes_is_the_take(tmp_path: Path) -> None:
    save_animation(sheet_rig(), sheet_take(), tmp_path / "take.glb")
    expected = read_gltf_weights(tmp_path / "take.glb")
    body = {"channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}], "samplers": []}
    again = {"name": "again", "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}], "samplers": []}
    with pytest.warns(UserWarning, match="take.glb: left out: the character's other animations: .*again$"):
        found = read_gltf_weights(edited(tmp_path / "take.glb", {}, (body,), (again,)))
    assert torch.equal(found.weights.values, expected.weights.values)


def test_keys_far_apart_keep_their_times(tmp_path: Path) -> None:
    rig, seconds = sheet_rig(), torch.tensor([0.0, 0.1, 0.2, 1.7])
    weights = torch.rand(4, len(rig.names), 1, generator=torch.Generator().manual_seed(0))
    save_animation(rig, Take(10.0, weights=Track(rig.names, weights), seconds=seconds), tmp_path / "take.glb")
    found = read_gltf_weights(tmp_path / "take.glb")
    torch.testing.assert_close(found.times, seconds.double(), atol=1e-6, rtol=0)
    assert found.fps == 10


def keyed(path: Path, way: str, seconds: torch.Tensor, keys: np.ndarray) -> Path:
    """A file whose one channel has these keys (T,N), or (T,3,N) of a cubic spline."""
    rig = sheet_rig()
    rows = keys.reshape(-1, len(rig.names))
    written = torch.from_numpy(rows.copy())[..., None]
    save_animation(rig, Take(10.0, weights=Track(rig.names, written), seconds=torch.arange(len(rows)) / 10), path)
    root, binary = unpacked(path)
    (sampler,) = root["animations"][0]["samplers"]
    where = root["bufferViews"][root["accessors"][sampler["input"]]["bufferView"]].get("byteOffset", 0)
    root["accessors"][sampler["input"]] |= {"count": len(seconds), "max": [float(seconds[-1])]}
    root["animations"][0]["samplers"] = [sampler | {"interpolation": way}]
    times = seconds.float().numpy().tobytes()
    path.write_bytes(packed(root, binary[:where] + times + binary[where + len(times) :]))
    return path


def hermite(seconds: np.ndarray, keys: np.ndarray, at: float) -> np.ndarray:
    """The cubic spline at one time as glTF 2.0, appendix C, writes it."""
    k = min(int(np.searchsorted(seconds, at, "right")) - 1, len(seconds) - 2)
    d = seconds[k + 1] - seconds[k]
    t = (at - seconds[k]) / d
    return (
        (2 * t**3 - 3 * t**2 + 1) * keys[k, 1]
        + d * (t**3 - 2 * t**2 + t) * keys[k, 2]
        + (-2 * t**3 + 3 * t**2) * keys[k + 1, 1]
        + d * (t**3 - t**2) * keys[k + 1, 0]
    )


def test_cubic_splines_between_few_keys_are_sampled(tmp_path: Path) -> None:
    seconds = np.array([0, 0.5, 0.9, 1.5, 2.0])
    shapes = len(sheet_rig().names)
    keys = np.random.default_rng(0).uniform(-1, 1, (5, 3, shapes)).astype(np.float32)
    keys[:, 1] = keys[:, 1] / 2 + 0.5
    found = read_gltf_weights(keyed(tmp_path / "take.glb", "CUBICSPLINE", torch.from_numpy(seconds), keys))
    assert (found.fps, len(found)) == (30.0, 61)  # 0.9 s is frame 27
    wanted = np.arange(121) / 60
    expected = np.stack([hermite(seconds, keys, at) for at in wanted])
    np.testing.assert_allclose(found.weights.values[..., 0], expected[::2], atol=1e-5)
    between = np.stack([np.interp(wanted, wanted[::2], column) for column in found.weights.values[..., 0].T], 1)
    assert np.abs(between - expected).max() < 0.01


def test_steps_hold_until_the_next_key(tmp_path: Path) -> None:
    seconds = torch.tensor([0.0, 0.125, 0.375, 1.625])  # frames of a film of 24, not of one of 30
    keys = np.random.default_rng(0).uniform(0, 1, (4, len(sheet_rig().names))).astype(np.float32)
    found = read_gltf_weights(keyed(tmp_path / "take.glb", "STEP", seconds, keys))
    assert (found.fps, len(found)) == (24.0, 40)
    expected = np.repeat(keys, [3, 6, 30, 1], axis=0)
    np.testing.assert_array_equal(found.weights.values[..., 0], expected)


@pytest.mark.parametrize("way", ["CUBICSPLINE", "STEP"])
def test_of_keys_in_one_frame_at_the_end_the_last_counts(way: str, tmp_path: Path) -> None:
    keys = np.random.default_rng(0).uniform(0, 1, (3, 3, len(sheet_rig().names))).astype(np.float32)
    keys = keys if way == "CUBICSPLINE" else keys[:, 1]
    found = read_gltf_weights(keyed(tmp_path / "take.glb", way, torch.tensor([0.0, 1.0, 1.0001]), keys))
    assert (found.fps, len(found)) == (30.0, 31)
    assert bool(found.weights.values.isfinite().all())
    last = keys[2, 1] if way == "CUBICSPLINE" else keys[2]
    np.testing.assert_allclose(found.weights.values[-1, :, 0], last, atol=1e-6)


def test_a_rig_at_rest_plays_nothing(tmp_path: Path) -> None:
    save_rig(sheet_rig(), tmp_path / "rig.glb")
    assert read_gltf_weights(tmp_path / "rig.glb") is None


def test_what_is_broken_is_named(tmp_path: Path) -> None:
    for change, told in (
        ({"channels": [{"sampler": 7, "target": {"node": 0, "path": "weights"}}]}, "less than 1"),
        ({"channels": [{"sampler": 0, "target": {"node": 9, "path": "weights"}}]}, "index into the 1 nodes"),
        ({"samplers": [{"input": 0, "output": 0}]}, "expected SCALAR"),
        ({"channels": 3}, "an array"),
    ):
        save_animation(sheet_rig(), sheet_take(), tmp_path / "take.glb")
        with pytest.raises(FileFormatError, match=told):
            read_gltf_weights(edited(tmp_path / "take.glb", change))


def test_mutated_animations_are_refused_or_read(tmp_path: Path) -> None:
    save_animation(sheet_rig(), sheet_take(), tmp_path / "take.glb")
    check_reader(read_gltf_weights, [tmp_path / "take.glb"], ".glb")


@pytest.mark.filterwarnings("ignore:.*left out. animations")
def test_a_performance_is_read_before_the_animations_that_the_file_had(tmp_path: Path) -> None:
    rig, path = sheet_rig(), tmp_path / "take.glb"
    save_animation(rig, sheet_take(), path)
    played = np.full((5, len(rig.names)), 0.25, np.float32)
    performance = Performance(np.arange(5) / 30, rig.names, played, np.zeros((5, 9)))
    (tmp_path / "performed.glb").write_bytes(performed_glb(read_document(path), performance))
    found = read_gltf_weights(tmp_path / "performed.glb")
    torch.testing.assert_close(found.weights.values[..., 0], torch.from_numpy(played))

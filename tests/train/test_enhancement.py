"""The recipe end to end: sequences in every form of file, a killed run, bad input."""

import zipfile
from dataclasses import replace
from pathlib import Path
from shutil import rmtree

import numpy as np
import pytest
import torch

from torchface import BlendshapeRig, Mesh, Take, Track, save_animation, save_mesh, zoo
from torchface.enhancement import EnhancementModel
from torchface.errors import AlignmentError, FileFormatError, TopologyError, TorchfaceError, ValueRangeError
from torchface.io import MeshSequenceWriter
from torchface.viz.figures import face_views
from train import captured_sequences
from train import enhancement as recipe
from train.captured_sequences import performed, read_capture
from train.enhancement import Settings, train


def sheet() -> Mesh:
    """A bowed square of skin, 24 by 24 vertices, 120 mm wide."""
    row = torch.linspace(-60, 60, 24)
    y, x = torch.meshgrid(row, row, indexing="ij")
    number = torch.arange(24 * 24).view(24, 24)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = torch.cat([torch.stack([a, b, d], -1).view(-1, 3), torch.stack([a, d, c], -1).view(-1, 3)])
    return Mesh(torch.stack([x, y, 40 - (x.square() + y.square()) / 120], -1).view(-1, 3), faces)


def frames(kind: int) -> torch.Tensor:
    """A bump at one of three places that comes and goes in nine frames, with waves on it, (9,V,3)."""
    rest = sheet().vertices
    centre = torch.tensor([[-35.0, -30.0], [35.0, -30.0], [0.0, 35.0]])[kind]
    bump = torch.exp(-(rest[:, :2] - centre).square().sum(1) / 800)
    course = torch.linspace(0, torch.pi, 9).sin().clamp(min=0)
    course[[0, -1]] = 0
    waves = 0.15 * (rest[:, 0] * 0.9).sin()
    moved = rest.repeat(9, 1, 1)
    moved[..., 2] += 8 * course[:, None] * bump * (1 + waves)
    return moved


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three sequences: a folder of meshes, an archive, meshes named by number; a mesh sequence; the neutral."""
    mesh, path = sheet(), tmp_path / "capture"
    (path / "a").mkdir(parents=True)
    save_mesh(mesh, path / "neutral.obj")
    for number, vertices in enumerate(frames(0)):
        save_mesh(replace(mesh, vertices=vertices), path / "a" / f"{number:03d}.ply")
    np.savez_compressed(path / "b.npz", vertices=frames(1).numpy(), faces=mesh.faces.numpy())
    for number, vertices in enumerate(frames(2)):
        save_mesh(replace(mesh, vertices=vertices), path / f"c_{number:03d}.obj")
    with MeshSequenceWriter(path / "d.safetensors", 9, len(mesh.vertices), mesh.faces) as writer:
        writer.append(0.6 * frames(0) + 0.4 * frames(2))
    return path


def settings(folder: Path, **other: object) -> Settings:
    return Settings(frames=folder, out=folder.parent / "model", patch=12, regions=3, rank=9, held_out=1, **other)


def test_all_forms_of_sequences_are_read_alike(folder):
    (folder / "a" / "._004.ply").write_bytes(b"\0\5\x16\7Mac OS X")
    found = {sequence.name: sequence for sequence in read_capture(folder, None).sequences}
    assert list(found) == ["a", "b.npz", "d.safetensors", "c"]
    assert found["a"].count == 9
    for name, kind in {"a": 0, "b.npz": 1, "c": 2}.items():
        assert torch.allclose(found[name].read(2, 7), frames(kind)[2:7], atol=1e-4)


def test_frames_follow_their_numbers_and_lost_ones_are_told(folder):
    for old in sorted(folder.glob("c_*.obj")):
        old.rename(folder / f"c_{int(old.stem[2:]) + 3}.obj")  # c_3 to c_11
    (folder / "a" / "004.ply").unlink()
    with pytest.warns(UserWarning, match="a: 1 of 9 frames are missing, first from 003.ply to 005.ply"):
        found = {sequence.name: sequence for sequence in read_capture(folder, None).sequences}
    assert torch.allclose(found["c"].read(0, 9), frames(2), atol=1e-4)


def test_an_animation_of_uneven_times_is_learned_at_an_even_rate(folder):
    mesh, times = sheet(), torch.tensor([0.0, 1, 2, 3, 4, 6, 8, 10, 12]) / 24
    rig = BlendshapeRig(mesh, frames(1)[4:5] - mesh.vertices, ("bump",))
    bump = Track(("bump",), torch.linspace(0, 1, 9)[:, None, None])
    save_animation(rig, Take(24.0, weights=bump, seconds=times), folder / "e.glb")
    with pytest.warns(UserWarning, match="e.glb: found 9 frames .*; brought to 13 at an even 24 a second"):
        found = {sequence.name: sequence for sequence in read_capture(folder, None).sequences}["e.glb"]
    assert (found.count, found.fps) == (13, 24)


def test_a_model_is_learned_measured_saved_and_drawn(folder, monkeypatch):
    monkeypatch.setattr(face_views, "render", lambda mesh, camera, *a, **k: torch.zeros(3, camera.height, camera.width))
    model = train(settings(folder))
    out = folder.parent / "model"
    told = zoo.describe(out).metrics
    assert told["frames learned from"] == 27
    assert told["learned: missing detail, of the smooth part's"] < 0.15
    assert 0 < told["held out: missing detail, of the smooth part's"] < 1
    assert {path.name for path in (out / "pictures").iterdir()} == {"regions.png", "learned.png", "held_out.png"}
    again = zoo.get_model(out)
    assert isinstance(again, EnhancementModel)
    assert torch.allclose(again(frames(0)), model(frames(0)), atol=0.02)  # features in half precision
    assert not list(folder.parent.glob(".*.training"))


def test_a_model_that_makes_other_sequences_worse_is_warned_of(folder, monkeypatch):
    monkeypatch.setattr(recipe, "draw", lambda *a: None)
    monkeypatch.setattr(recipe, "measured", lambda *a: {"held out: missing detail, of the coarse frames'": 1.1})
    with pytest.warns(UserWarning, match=r"found errors 1.10 times those of the coarse frames, expected less than 1"):
        train(settings(folder))


def test_another_persons_sequences_are_warned_of(folder, monkeypatch):
    """Another head in the same vertices, one learned from and one held out; the head in metres is refused by name."""
    monkeypatch.setattr(recipe, "draw", lambda *a: None)
    mesh, wider = sheet(), sheet().vertices[:, 0].square() / 200

    def another(name: str, scale: float) -> None:
        moved = frames(1)
        moved[..., 2] += wider
        np.savez_compressed(folder / name, vertices=scale * moved.numpy(), faces=mesh.faces.numpy())

    another("b.npz", 1.0)
    with pytest.warns(UserWarning, match=r"1 of 4 sequences come .* b\.npz [2-9]\.\d mm .*another person"):
        train(settings(folder))
    another("z.npz", 0.001)
    with pytest.raises(AlignmentError, match=r"z\.npz: found a head .* in metres .* scale the files to millimetres\)"):
        train(settings(folder))


def test_a_run_that_is_killed_goes_on(folder, monkeypatch):
    monkeypatch.setattr(recipe, "draw", lambda *a: None)
    whole = train(settings(folder))
    begun = []

    def killed(step: str, done: int = 0, total: int = 0) -> None:
        if step == "gathering frames" and done > 10:
            raise KeyboardInterrupt

    def told(step: str, done: int = 0, total: int = 0) -> None:
        if step == "gathering frames":
            begun.append(done)

    monkeypatch.setattr(captured_sequences, "_BLOCK", 2)
    monkeypatch.setattr("torchface.io.meshes.mesh_sequence._NOTE_SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        train(settings(folder), killed)
    found = train(settings(folder), told)
    assert begun[0] > 10
    assert torch.equal(found.database_features, whole.database_features)


def test_what_a_coarse_animation_lacks_of_the_same_frames_is_learned(folder, monkeypatch):
    """Coarse frames whose bumps are too low by a third, which a smooth part could not tell, come back whole."""
    monkeypatch.setattr(recipe, "draw", lambda *a: None)
    coarse, rest = folder.parent / "coarse", sheet().vertices
    coarse.mkdir()
    shown = [rest + (frames(kind) - rest) * 2 / 3 for kind in range(3)]
    for name, vertices in zip("abc", shown, strict=True):
        np.savez(coarse / f"{name}.npz", vertices=vertices.numpy(), faces=sheet().faces.numpy())
    with pytest.raises(ValueRangeError, match=r"coarse: found no sequence for d.safetensors, expected its 9 frames"):
        train(settings(folder, coarse=coarse))
    lower = rest + (0.6 * frames(0) + 0.4 * frames(2) - rest) * 2 / 3
    np.savez(coarse / "d.npz", vertices=lower.numpy(), faces=sheet().faces.flip(0).numpy())
    with pytest.raises(TopologyError, match=r"coarse.d\.npz: found 1058 triangles"):
        train(settings(folder, coarse=coarse))
    np.savez(coarse / "d.npz", vertices=lower.numpy(), faces=sheet().faces.numpy())
    model = train(settings(folder, coarse=coarse))
    assert zoo.describe(folder.parent / "model").metrics["learned: missing detail, of the coarse frames'"] < 0.1
    left = (model(shown[1]) - frames(1)).square().mean().sqrt()
    assert float(left) < 0.1 * float((shown[1] - frames(1)).square().mean().sqrt())


def test_a_coarse_animation_in_another_place_is_refused(folder, monkeypatch):
    """Its way from the captured heads would be learned as an error, and the share that is left look small."""
    monkeypatch.setattr(recipe, "draw", lambda *a: None)
    coarse, mesh = folder.parent / "coarse", sheet()
    coarse.mkdir()
    for name, vertices in zip("abcd", (*map(frames, range(3)), 0.6 * frames(0) + 0.4 * frames(2)), strict=True):
        moved = vertices + torch.tensor([0.0, 100.0, 0.0])
        np.savez(coarse / f"{name}.npz", vertices=moved.numpy(), faces=mesh.faces.numpy())
    with pytest.raises(AlignmentError, match=r"coarse: found heads 100 mm from those of .*capture"):
        train(settings(folder, coarse=coarse))


def test_the_rate_is_that_of_the_files_and_of_all_of_them(folder, monkeypatch):
    monkeypatch.setattr(recipe, "draw", lambda *a: None)
    coarse, mesh = folder.parent / "coarse", sheet()
    coarse.mkdir()
    bump = BlendshapeRig(mesh, (frames(0)[4:5] - mesh.vertices), ("one",))
    weights = Track(bump.names, torch.linspace(0, torch.pi, 9).sin().clamp(min=0)[:, None, None])
    for name in "abcd":
        save_animation(bump, Take(25.0, weights=weights), coarse / f"{name}.glb")
    assert train(settings(coarse, neutral=folder / "neutral.obj")).fps == 25
    with pytest.raises(ValueRangeError, match=r"a.glb: found 25 frames a second, expected the 30 of .*\(--fps"):
        train(settings(folder, coarse=coarse, fps=30.0))
    save_animation(bump, Take(60.0, weights=weights), coarse / "c.glb")
    with pytest.raises(ValueRangeError, match=r"c.glb: found 60 frames .* the 25 of the other sequences"):
        train(settings(folder, coarse=coarse))


@pytest.mark.parametrize(("kept", "learned"), [("ab", [1, 1]), ("abc", [2, 1]), ("abcd", [2, 2]), ("a", [1])])
def test_at_most_half_of_the_sequences_and_two_are_held_out(folder, monkeypatch, kept, learned):
    for path in [path for name in set("abcd") - set(kept) for path in folder.glob(f"{name}*")]:
        rmtree(path) if path.is_dir() else path.unlink()
    seen = []

    def gathered(capture, *_, **__):
        seen.append(len(capture.sequences))
        if len(seen) == len(learned):
            raise InterruptedError
        return None, None

    monkeypatch.setattr(f"{train.__module__}.gather", gathered)
    with pytest.raises(InterruptedError):
        train(replace(settings(folder), held_out=None))
    assert seen == learned


def test_broken_captures_are_told(folder):
    def fails(error: type[TorchfaceError], words: str) -> None:
        with pytest.raises(error, match=words):
            train(settings(folder))

    with pytest.raises(TorchfaceError, match="expected one: --frames or --performer"):
        train(Settings())
    with pytest.raises(ValueRangeError, match="--performer: vertices: found 300"):
        train(Settings(performer=300))
    with pytest.raises(ValueRangeError, match="--held-out: found 9 of 4 sequences"):
        train(replace(settings(folder), held_out=9))
    with pytest.raises(FileFormatError, match="found no such folder"):
        train(settings(folder / "none"))
    broken = frames(1).numpy().copy()
    broken[4, 7] = np.nan
    np.savez(folder / "b.npz", vertices=broken, faces=sheet().faces.numpy())
    fails(ValueRangeError, r"b.npz: frame 4 holds NaN")
    np.savez(folder / "b.npz", vertices=broken, faces=sheet().faces.flip(0).numpy())
    fails(TopologyError, r"b.npz: found 1058 triangles, expected the 1058 of neutral.obj, in their order")
    (folder / "neutral.obj").rename(folder / "rest.obj")
    fails(FileFormatError, r"found 0 files called neutral")


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"vertices": np.zeros((2, 4, 3))}, "faces"),
        (
            {"vertices": np.array([{}], dtype=object), "faces": np.zeros((1, 3), int)},
            r"found vertices of O\[1\], expected \(\*,\*,3\)",
        ),
        (
            {"vertices": np.zeros((4, 3)), "faces": np.zeros((1, 3), int)},
            r"found vertices of f\[4, 3\], expected \(\*,\*,3\)",
        ),
        (
            {"vertices": np.zeros((2, 4, 3)), "faces": np.full((1, 3), 9)},
            "found faces from 9 to 9, expected whole numbers from 0 to 3",
        ),
    ],
)
def test_archives_of_something_else_are_refused(folder, arrays, words):
    np.savez(folder / "b.npz", **arrays)
    with pytest.raises(FileFormatError, match=words):
        read_capture(folder, None)


def test_an_archive_that_promises_more_than_it_holds_takes_no_memory(folder):
    head = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 100000, 3), }"
    head += b" " * (117 - len(head)) + b"\n"
    with zipfile.ZipFile(folder / "b.npz", "w") as archive:
        archive.writestr("vertices.npy", b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head)
    with pytest.raises(FileFormatError, match="found vertices of 1200000000000 bytes, expected at most 1"):
        read_capture(folder, None)


def test_the_performers_takes_begin_and_end_at_rest():
    capture = performed(3000, 0, 15.0)
    assert len(capture.sequences) == 36
    one = capture.sequences[0]
    moved = one.read(0, one.count)
    assert torch.allclose(moved[0], capture.neutral.vertices, atol=1e-4)
    assert float((moved - capture.neutral.vertices).norm(dim=-1).max()) > 3
    assert torch.equal(one.read(3, 5), moved[3:5])


def test_colours_of_meshes_are_learned_and_given_back(tmp_path, monkeypatch):
    """Skin that reddens where a bump rises: an enhanced bump is as red, and the rest of the face is not."""
    monkeypatch.setattr(recipe, "draw", lambda *a: None)
    mesh, path = sheet(), tmp_path / "capture"

    def skin(vertices: torch.Tensor) -> torch.Tensor:
        red = ((vertices[:, 2] - mesh.vertices[:, 2]) / 16).clamp(0, 0.5)
        return torch.stack([0.5 + red, 0.5 - red / 2, 0.5 - red / 2], -1)

    for kind in range(3):
        (path / f"s{kind}").mkdir(parents=True)
        for number, vertices in enumerate(frames(kind)):
            colored = replace(mesh, vertices=vertices, colors=skin(vertices))
            save_mesh(colored, path / f"s{kind}" / f"{number:03d}.ply")
    save_mesh(mesh, path / "neutral.obj")
    model = train(replace(settings(path, matching="projection"), held_out=0))
    assert model.settings.matching == "projection"
    shown = frames(1)[4:5]
    found = model.colors(model.enhance(shown).weights)[0]
    away = (found - skin(shown[0])).abs()
    assert away.mean() < 0.02
    assert float((model.mean_color - skin(shown[0])).abs().mean()) > 2 * float(away.mean())

"""Every kind of input through the whole job; killed runs, full disks, and input that does not fit."""

import errno
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.workflows.enhance.conftest import FPS, FRAMES, Actor, coarse, folded, shuffled, written
from torchface import (
    BlendshapeRig,
    Mesh,
    Take,
    Track,
    load_rig,
    load_take,
    save_animation,
    save_mesh,
    save_rig,
    save_take,
    zoo,
)
from torchface.enhancement import CapturedPerformance, EnhancementModel, EnhancementSettings
from torchface.errors import (
    AlignmentError,
    FileFormatError,
    NameMismatchError,
    ShapeError,
    TopologyError,
    ValueRangeError,
)
from torchface.io import MeshSequence, MeshSequenceWriter, load_image
from torchface.io.gltf.animation_reading import read_gltf_weights
from torchface.progress import silent
from torchface.rendering.clay_shading import sample_texture
from torchface.workflows.animated_meshes import load_animated
from torchface.workflows.enhance import enhance_views, enhanced_frames
from torchface.workflows.enhance.coarse_input import InputSettings
from torchface.workflows.enhance.enhance_animation import EnhanceSettings, animation_targets, enhance_animation
from torchface.workflows.enhance.enhance_page import write_enhance_page
from torchface.workflows.marker_input import MarkerOptions

PLAIN = EnhanceSettings(glb=False, video=False)


@pytest.fixture(scope="module")
def expected(actor: Actor) -> torch.Tensor:
    with torch.no_grad():
        return zoo.get_model(Path(actor.model)).enhance(actor.frames).vertices


def test_weights_become_meshes_an_animation_a_video_and_a_report(
    actor: Actor, expected: torch.Tensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(enhance_views, "_VIDEO_HEIGHT", 80)
    settings = EnhanceSettings(InputSettings(rig=actor.folder / "rig.glb"), meshes="ply")
    done = enhance_animation(actor.folder / "weights.csv", actor.model, tmp_path, settings)
    found = MeshSequence(tmp_path / "enhanced.safetensors").read(0, FRAMES)
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)
    rig, take = load_rig(tmp_path / "enhanced.glb"), played(tmp_path / "enhanced.glb")
    torch.testing.assert_close(rig(take), found, atol=2e-3, rtol=0)
    assert len(list((tmp_path / "meshes").glob("*.ply"))) == FRAMES
    page = write_enhance_page(done, tmp_path, height=64).read_text()
    assert "comparison.mp4" in page
    assert "frames.png" in page
    assert f"{FRAMES} frames of meshes of the model&#x27;s topology" in page
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["residual_mm"] < 0.01
    assert summary["frames"] == FRAMES
    assert summary["fps"] == FPS


def played(path: Path) -> torch.Tensor:
    take = read_gltf_weights(path)
    return take.weights.values[..., 0]


def test_all_files_of_one_animation_give_the_same(actor: Actor, tmp_path: Path) -> None:
    frames = actor.frames
    sequence = written(tmp_path / "meshes.safetensors", frames, actor.mesh.faces)
    save_animation(actor.rig, load_take(actor.folder / "weights.csv"), tmp_path / "animation.glb")
    for folder in ("objs", "tracked"):
        (tmp_path / folder).mkdir()
    for t in range(FRAMES):
        save_mesh(Mesh(frames[t], actor.mesh.faces), tmp_path / "objs" / f"frame_{t:02d}.obj")
    save_animation(actor.rig, load_take(actor.folder / "weights.csv"), tmp_path / "tracked" / "animation.glb")
    (tmp_path / "tracked" / "summary.json").write_text("{}")
    for path in (sequence, tmp_path / "animation.glb", tmp_path / "objs", tmp_path / "tracked"):
        found = coarse(actor, path, tmp_path)
        torch.testing.assert_close(found.read(3, 7), frames[3:7], atol=2e-3, rtol=0)
        assert found.fps == FPS
    assert "30 a second are assumed" in " ".join(coarse(actor, sequence, tmp_path).notes)
    for path in (tmp_path / "animation.glb", tmp_path / "tracked"):
        note = coarse(actor, path, tmp_path, rig=actor.folder / "rig.glb").notes[0]
        assert note == f"warning: --rig {actor.folder / 'rig.glb'} is not used: animation.glb has its own rig"


def test_meshes_in_metres_are_read_by_their_unit(actor: Actor, tmp_path: Path) -> None:
    frames, faces = actor.frames, actor.mesh.faces
    (tmp_path / "plys").mkdir()
    for t in range(FRAMES):
        save_mesh(Mesh(frames[t] / 1000, faces), tmp_path / "plys" / f"frame_{t:02d}.ply")
    np.savez(tmp_path / "arrays.npz", vertices=frames / 1000, faces=faces)
    in_metres = MarkerOptions(unit="m")
    for path in (tmp_path / "plys", tmp_path / "arrays.npz"):
        found = coarse(actor, path, tmp_path, markers=in_metres)
        torch.testing.assert_close(found.read(3, 7), frames[3:7], atol=2e-3, rtol=0)
        with pytest.raises(AlignmentError, match=r"it seems to be in metres \(--unit"):
            coarse(actor, path, tmp_path)
    save_animation(actor.rig, load_take(actor.folder / "weights.csv"), tmp_path / "animation.glb")
    with pytest.raises(ValueRangeError, match=r"found --unit m, expected it of markers and meshes alone, not of \.glb"):
        coarse(actor, tmp_path / "animation.glb", tmp_path, markers=in_metres)


def test_a_result_has_the_rate_of_its_input(actor: Actor, tmp_path: Path) -> None:
    take = load_take(actor.folder / "weights.csv")
    save_take(replace(take, fps=2 * FPS), tmp_path / "weights.csv")
    settings = replace(PLAIN, given=InputSettings(rig=actor.folder / "rig.glb"))
    enhance_animation(tmp_path / "weights.csv", actor.model, tmp_path, settings)
    assert load_animated(tmp_path / "enhanced.safetensors").fps == 2 * FPS


def test_uneven_times_are_brought_to_an_even_rate_and_said(actor: Actor, tmp_path: Path) -> None:
    left = [0, 1, 2, 4, 5, 6, 7, 10, 11]  # the weights are linear in time
    points = actor.attachment.on(actor.mesh.faces, actor.frames)
    take = Take(
        FPS, Track(actor.attachment.labels or (), points), weights=Track(actor.rig.names, actor.weights[..., None])
    )
    uneven = Take(
        FPS,
        Track(take.markers.names, points[left]),
        weights=Track(take.weights.names, take.weights.values[left]),
        seconds=torch.tensor(left, dtype=torch.float64) / FPS,
    )
    sites = {"rig": actor.folder / "rig.glb", "attachment": actor.folder / "attachment.json", "neutral": 0}
    said = "found 9 frames about 30 a second at uneven times, up to 0.1 s apart; brought to 12 at an even 30"
    for kind, given in (("weights", {"rig": actor.folder / "rig.glb"}), ("markers", sites)):
        frames = []
        for name, one in (("even", take), ("uneven", uneven)):
            path = tmp_path / f"{name}_{kind}.csv"
            save_take(replace(one, **{"markers" if kind == "weights" else "weights": None}), path)
            found = coarse(actor, path, tmp_path, **given)
            assert (found.count, found.fps) == (FRAMES, FPS)
            assert any(said in note for note in found.notes) == (name == "uneven")
            frames.append(found.read(0, FRAMES))
        torch.testing.assert_close(frames[0], frames[1], atol=2e-2, rtol=0)


def test_lost_meshes_of_a_folder_are_told(actor: Actor, tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    for t in (0, 1, 2, 5):
        save_mesh(Mesh(actor.frames[t], actor.mesh.faces), tmp_path / "meshes" / f"f{t}.ply")
    notes = coarse(actor, tmp_path / "meshes", tmp_path).notes
    assert "warning: meshes: 2 of 6 frames are missing, first from f2.ply to f5.ply" in notes


@pytest.fixture
def killed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Has the third piece of four frames end the run; gives the frames that went through the model."""
    monkeypatch.setattr(enhanced_frames, "_MOST_A_PIECE", 4)
    seen: list[int] = []
    whole = EnhancementModel.enhance

    def enhance(self: EnhancementModel, frames: torch.Tensor, *others: torch.Tensor | None) -> Any:
        if len(seen) == 8:
            seen.append(0)
            raise KeyboardInterrupt
        seen.extend([1] * len(frames))
        return whole(self, frames, *others)

    monkeypatch.setattr(EnhancementModel, "enhance", enhance)
    return seen


def test_a_killed_run_goes_on(actor: Actor, expected: torch.Tensor, tmp_path: Path, killed: list[int]) -> None:
    settings = replace(PLAIN, given=InputSettings(rig=actor.folder / "rig.glb"))
    with pytest.raises(KeyboardInterrupt):
        enhance_animation(actor.folder / "weights.csv", actor.model, tmp_path, settings)
    assert not (tmp_path / "enhanced.safetensors").exists()
    done = enhance_animation(actor.folder / "weights.csv", actor.model, tmp_path, settings)
    assert done.frames.enhanced == FRAMES - 8
    torch.testing.assert_close(done.frames.sequence.read(0, FRAMES), expected, atol=2e-3, rtol=0)
    assert done.frames.distances.shape == (FRAMES, len(done.model.regions.names))
    again = enhance_animation(actor.folder / "weights.csv", actor.model, tmp_path, settings)
    assert again.frames.enhanced == 0
    torch.testing.assert_close(again.frames.distances, done.frames.distances)
    other = enhance_animation(
        written(tmp_path / "other.safetensors", actor.frames[:4], actor.mesh.faces), actor.model, tmp_path, PLAIN
    )
    assert other.frames.enhanced == 4


def test_a_full_disk_is_told_and_leaves_nothing_half(
    actor: Actor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = replace(PLAIN, given=InputSettings(rig=actor.folder / "rig.glb"))
    with monkeypatch.context() as patch:
        patch.setattr(enhanced_frames.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000}))
        with pytest.raises(FileFormatError, match=r"found 0\.1 MB free, expected 0\.3 for 12 frames"):
            enhance_animation(actor.folder / "weights.csv", actor.model, tmp_path, settings)
    monkeypatch.setattr(enhanced_frames, "_MOST_A_PIECE", 4)
    appended = MeshSequenceWriter.append

    def full(self: MeshSequenceWriter, vertices: torch.Tensor) -> None:
        if self.done >= 4:
            self._file.close()
            raise FileFormatError(f"{self.path}: cannot be written ({errno.errorcode[errno.ENOSPC]})")
        appended(self, vertices)

    monkeypatch.setattr(MeshSequenceWriter, "append", full)
    with pytest.raises(FileFormatError, match=r"enhanced.safetensors: cannot be written"):
        enhance_animation(actor.folder / "weights.csv", actor.model, tmp_path, settings)
    assert not (tmp_path / "enhanced.safetensors").exists()
    assert not (tmp_path / "summary.json").exists()


def test_long_animations_are_shown_by_components(actor: Actor, tmp_path: Path) -> None:
    sequence = MeshSequence(written(tmp_path / "meshes.safetensors", actor.frames, actor.mesh.faces))
    each = 24 * len(actor.mesh.vertices) / 1e6
    targets = animation_targets(sequence, actor.mesh.vertices, 4.5 * each, silent)
    assert targets.kind == "components"
    assert len(targets.deltas) <= 4
    shown = actor.mesh.vertices + torch.einsum("tn,nvc->tvc", targets.weights, targets.deltas)
    off = (shown - actor.frames).square().sum(-1).mean().sqrt()
    assert float(off) == pytest.approx(targets.rms, rel=1e-2, abs=1e-4)
    assert float(off) < 0.05  # two extremes span the take
    with pytest.raises(ValueRangeError, match="expected at least"):
        animation_targets(sequence, actor.mesh.vertices, 0.5 * each, silent)


def test_another_actor_keeps_the_own_head_and_gets_the_detail(actor: Actor, tmp_path: Path) -> None:
    wide = torch.tensor([1.12, 1.0, 0.92])
    other = BlendshapeRig(
        actor.mesh.with_vertices(actor.mesh.vertices * wide), actor.rig.deltas * wide, actor.rig.names
    )
    save_rig(other, tmp_path / "other.glb")
    made = {}
    for detail in (0.0, 1.0):
        settings = replace(PLAIN, given=InputSettings(rig=tmp_path / "other.glb"), detail=detail)
        done = enhance_animation(actor.folder / "weights.csv", actor.model, tmp_path / str(detail), settings)
        assert any("another person" in line for line in done.notes)
        made[detail] = done.frames.sequence.read(0, FRAMES)
    frames = other(actor.weights)
    assert float((made[1.0] - frames).norm(dim=-1).mean()) < 0.5
    model = zoo.get_model(Path(actor.model))
    with torch.no_grad():
        plain = model.on_actor(model.neutral, 0.0).enhance(actor.frames[-1:]).vertices[0]
        own = model.enhance(actor.frames[-1:]).vertices[0] - plain
    added = made[1.0][-1] - made[0.0][-1]
    assert float(own.norm(dim=-1).max()) > 0.3
    assert float(torch.corrcoef(torch.stack([added.flatten(), own.flatten()]))[0, 1]) > 0.9


def test_learned_colours_are_images_in_a_meshs_texture_coordinates(actor: Actor, tmp_path: Path) -> None:
    mesh, frames = actor.mesh, folded(actor.frames, actor.mesh.vertices)
    blush = (mesh.vertices[:, :1] / 160 + 0.5) * torch.linspace(0, 0.4, FRAMES)[:, None, None]
    colors = 0.5 + blush * torch.tensor([1.0, -0.5, -0.5])
    captured = CapturedPerformance(frames, mesh.faces, torch.zeros(FRAMES).long(), mesh.vertices, colors=colors)
    model = EnhancementModel.fit(captured, EnhancementSettings(fps=FPS), rank=4)
    zoo.save_model(model, tmp_path / "model", zoo.ModelCard("MIT", "made", {}, "here"))
    save_mesh(mesh, tmp_path / "painted.glb")
    settings = EnhanceSettings(
        InputSettings(rig=actor.folder / "rig.glb"), glb=False, video=False, textures=tmp_path / "painted.glb",
        texture_size=256,
    )  # fmt: skip
    out, weights = tmp_path / "out", actor.folder / "weights.csv"
    done = enhance_animation(weights, str(tmp_path / "model"), out, settings)
    assert done.products["colours, an image a frame"] == out / "textures"
    assert len(list((out / "textures").glob("*.png"))) == FRAMES
    known = MeshSequence(out / "colors.safetensors").read(FRAMES - 1, FRAMES)[0]
    corner = torch.zeros(len(mesh.vertices), 2)
    corner[mesh.faces.flatten()] = mesh.uvs[mesh.uv_faces.flatten()]
    last = load_image(out / "textures" / f"frame_{FRAMES - 1:04d}.png")
    shown = sample_texture(last, corner)
    assert float((shown - known).abs().median()) < 0.01
    assert float((known - 0.5).abs().max()) > 0.2
    with pytest.raises(ValueRangeError, match=r"--textures: found the model .*, which knows no colours"):
        enhance_animation(weights, actor.model, tmp_path / "none", settings)
    save_mesh(Mesh(mesh.vertices, mesh.faces), tmp_path / "bare.obj")
    save_mesh(
        replace(mesh, faces=mesh.faces.flip(0), uv_faces=mesh.uv_faces.flip(0), polygons=None), tmp_path / "o.glb"
    )
    for name, said in (("bare.obj", "without texture coordinates"), ("o.glb", "in their order")):
        other = replace(settings, textures=tmp_path / name)
        with pytest.raises(TopologyError, match=said):
            enhance_animation(weights, str(tmp_path / "model"), tmp_path / "none", other)


def test_what_does_not_fit_the_model_is_named(actor: Actor, tmp_path: Path) -> None:
    faces = actor.mesh.faces
    large = written(tmp_path / "large.safetensors", 10 * actor.frames, faces)
    with pytest.raises(AlignmentError, match=r"10\.\d times too large"):
        coarse(actor, large, tmp_path)
    empty = actor.frames.clone()
    empty[5] = 0
    with pytest.raises(ValueRangeError, match=r"empty\.safetensors: found all vertices of frame 5 in one place"):
        coarse(actor, written(tmp_path / "empty.safetensors", empty, faces), tmp_path)
    broken = actor.frames.clone()
    broken[5, 3] = torch.nan
    with pytest.raises(ValueRangeError, match="NaN or infinity in frame 5"):
        coarse(actor, written(tmp_path / "nan.safetensors", broken, faces), tmp_path)
    order, _ = shuffled(actor)
    with pytest.raises(AlignmentError, match="stand in another order"):
        coarse(actor, written(tmp_path / "order.safetensors", actor.frames[:, order], faces), tmp_path)
    wider = actor.frames * torch.tensor([1.15, 1.0, 0.9])
    other = written(tmp_path / "wider.safetensors", wider, faces)
    notes = coarse(actor, other, tmp_path).notes
    assert any(line.startswith("warning: ") and "another person" in line for line in notes)
    with pytest.raises(AlignmentError, match=r"another person, whose head would become dents; .*\(--rig\)"):
        enhance_animation(other, actor.model, tmp_path / "other", PLAIN)
    assert not (tmp_path / "other").exists()
    stretch = torch.tensor([1.15, 1.0, 0.9])
    own = BlendshapeRig(actor.mesh.with_vertices(actor.mesh.vertices * stretch), actor.rig.deltas, actor.rig.names)
    save_rig(own, tmp_path / "own.glb")
    given = replace(PLAIN, given=InputSettings(rig=tmp_path / "own.glb"))
    done = enhance_animation(other, actor.model, tmp_path / "other", given)
    assert any("keeps the input's own head" in line for line in done.notes)
    assert float((done.frames.sequence.read(0, FRAMES) - wider).norm(dim=-1).mean()) < 0.5
    with pytest.raises(NameMismatchError, match=r"\(--rig\)"):
        coarse(actor, actor.folder / "weights.csv", tmp_path)
    with pytest.raises(ValueRangeError, match="found --attachment and no markers"):
        coarse(actor, large, tmp_path, attachment=actor.folder / "attachment.json")
    with pytest.raises(FileFormatError, match="no such file"):
        coarse(actor, tmp_path / "nothing.glb", tmp_path)
    few = tmp_path / "few.csv"
    few.write_text("input,model\n" + "\n".join(f"{i},{i}" for i in range(11)))
    other = written(tmp_path / "other.safetensors", actor.frames[:, order], shuffled(actor)[1])
    with pytest.raises(ShapeError, match="found 11 pairs, expected at least 12"):
        coarse(actor, other, tmp_path, pairs=few)


def test_a_model_of_another_kind_is_named(tmp_path: Path) -> None:
    with pytest.raises(NameMismatchError, match="expected an EnhancementModel"):
        enhance_animation(tmp_path / "take.c3d", "shape_prior", tmp_path / "out", PLAIN)

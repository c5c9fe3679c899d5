"""Markers as an animation of the model: in any place they move the face as the rig did; what does not fit is named."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.workflows.enhance.conftest import FPS, FRAMES, Actor, coarse
from torchface import Attachment, Take, Track, save_take
from torchface.errors import AlignmentError, NameMismatchError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import similarity_transform
from torchface.synthetic.stages import place_markers


@pytest.mark.parametrize("freely", [False, True])
def test_markers_in_any_place_move_the_face_as_the_rig_did(actor: Actor, tmp_path: Path, freely: bool) -> None:
    phase = freely * torch.arange(FRAMES) / 2.0
    turn = rotation_matrix(torch.tensor([0.1, 0.6, -0.2]) + 0.8 * torch.stack([phase.sin(), 0 * phase, 0 * phase], 1))
    walked = torch.tensor([40.0, 1500.0, 7.0]) + 600 * torch.stack([0 * phase, 0 * phase, phase.sin()], 1)
    points = actor.attachment.on(actor.mesh.faces, actor.frames)
    points[2, 5:9] = torch.nan
    points[6] = torch.nan
    markers = Track(actor.attachment.labels or (), points @ turn.transpose(1, 2) + walked[:, None])
    save_take(Take(FPS, markers=markers), tmp_path / "take.c3d")
    given = {"attachment": actor.folder / "attachment.json", "rig": actor.folder / "rig.glb"}
    rows = [t for t in range(FRAMES) if t != 6]
    for own in ({**given, "neutral": 0}, {**given, "rig": None}):
        found = coarse(actor, tmp_path / "take.c3d", tmp_path, **own)
        moved, true = (actor.attachment.on(actor.mesh.faces, x)[rows] for x in (found.read(0, FRAMES), actor.frames))
        laid = similarity_transform(moved, true, scale=False).apply(moved)
        assert float((laid - true).norm(dim=-1).mean()) < 0.3
        if not freely:
            steps, wanted = (x[:, 1:6] - x[:, :5] for x in (found.read(0, 6)[None], actor.frames[None, :6]))
            assert float((steps - wanted).norm(dim=-1).mean()) < 0.4 * float(wanted.norm(dim=-1).mean())
        assert any("1 of 12 frames (the first 6) show fewer than 12 markers" in line for line in found.notes)
        assert found.shown(2, 3)[0, 5:9].isnan().all()


def test_markers_that_do_not_fit_are_named(actor: Actor, tmp_path: Path) -> None:
    points = actor.attachment.on(actor.mesh.faces, actor.frames)
    take, sites = tmp_path / "take.trc", actor.folder / "attachment.json"
    labels = actor.attachment.labels or ()
    save_take(Take(FPS, markers=Track(labels, points)), take)
    with pytest.raises(NameMismatchError, match=r"\(--attachment\)"):
        coarse(actor, take, tmp_path)
    eleven = tmp_path / "eleven.json"
    actor.attachment.select(labels[:11]).save(eleven)
    with pytest.raises(ShapeError, match="found 11 markers, expected at least 12"):
        coarse(actor, take, tmp_path, attachment=eleven)
    foreign = tmp_path / "foreign.json"
    Attachment(actor.attachment.triangles, actor.attachment.barycentric, labels, None, "9-0123456789abcdef").save(
        foreign
    )
    with pytest.raises(TopologyError, match=r"expected the model's.*\(--rig\)"):
        coarse(actor, take, tmp_path, attachment=foreign)
    large = tmp_path / "large.trc"
    save_take(Take(FPS, markers=Track(labels, 10 * points)), large)
    with pytest.raises(AlignmentError, match=r"10\.\d times too large.*--unit"):
        coarse(actor, large, tmp_path, attachment=sites)
    mixed = tmp_path / "mixed.trc"
    save_take(Take(FPS, markers=Track(labels, points[:, torch.randperm(60)])), mixed)
    with pytest.raises(AlignmentError):
        coarse(actor, mixed, tmp_path, attachment=sites)


def test_two_exchanged_labels_are_named(actor: Actor, tmp_path: Path) -> None:
    """Two labels of sixty, near to each other, half a face apart, and so far apart that the take is refused."""
    points, labels = actor.attachment.on(actor.mesh.faces, actor.frames), actor.attachment.labels or ()
    apart = torch.cdist(points[0], points[0])
    for distance in 8.0, 50.0, float(apart.max()):
        first, second = divmod(int((apart - distance).abs().argmin()), 60)
        names = " and ".join(labels[i] for i in sorted((first, second)))
        order = list(range(60))
        order[first], order[second] = second, first
        save_take(Take(FPS, markers=Track(labels, points[:, order])), tmp_path / "swap.trc")
        if distance > 100:
            with pytest.raises(AlignmentError, match=f"the labels {names} seem to be exchanged"):
                coarse(actor, tmp_path / "swap.trc", tmp_path, attachment=actor.folder / "attachment.json")
            continue
        found = coarse(actor, tmp_path / "swap.trc", tmp_path, attachment=actor.folder / "attachment.json")
        assert [line for line in found.notes if f"the labels {names} seem to be exchanged" in line]
        assert not any("--neutral" in line for line in found.notes)
    save_take(Take(FPS, markers=Track(labels, points)), tmp_path / "right.trc")
    found = coarse(actor, tmp_path / "right.trc", tmp_path, attachment=actor.folder / "attachment.json")
    assert not any("exchanged" in line for line in found.notes)


def test_a_marker_that_is_astray_in_one_frame_counts_as_not_seen_there(actor: Actor, tmp_path: Path) -> None:
    points, labels = actor.attachment.on(actor.mesh.faces, actor.frames), actor.attachment.labels or ()
    points[7, 3] += torch.tensor([500.0, 500.0, 500.0])
    points[10:] = torch.nan
    save_take(Take(FPS, markers=Track(labels, points)), tmp_path / "take.trc")
    found = coarse(actor, tmp_path / "take.trc", tmp_path, attachment=actor.folder / "attachment.json")
    assert any(f"{labels[3]} in frame 7 by 86" in line and "left out" in line for line in found.notes)
    assert found.shown(0, FRAMES).isnan().any(-1).nonzero().tolist() == [[7, 3]]
    assert float((found.read(7, 8) - actor.frames[7]).norm(dim=-1).max()) < 5
    assert torch.equal(found.read(10, 11), found.read(9, 10))
    assert any("and held at the take's ends" in line for line in found.notes)


def test_frames_of_a_trimmed_take_go_by_their_numbers(actor: Actor, tmp_path: Path) -> None:
    points, labels = actor.attachment.on(actor.mesh.faces, actor.frames), actor.attachment.labels or ()
    points[7, 3] += 500.0
    points[9] = torch.nan
    whole = Take(FPS, markers=Track(labels, points))
    save_take(whole.frames(slice(3, None)), tmp_path / "cut.c3d")
    save_take(replace(whole.frames(slice(3, None)), extras={}), tmp_path / "own.c3d")
    given = {"attachment": actor.folder / "attachment.json", "rig": actor.folder / "rig.glb"}
    cut, own = (coarse(actor, tmp_path / f"{name}.c3d", tmp_path, **given, neutral=number)
                for name, number in (("cut", 5), ("own", 2)))  # fmt: skip
    assert torch.equal(cut.read(0, 9), own.read(0, 9))
    assert any(f"{labels[3]} in frame 7 by 86" in line for line in cut.notes)
    assert any("(the first 9) show fewer" in line for line in cut.notes)
    with pytest.raises(ValueRangeError, match="found frame 2, expected one of those that are used, 3 to 11"):
        coarse(actor, tmp_path / "cut.c3d", tmp_path, **given, neutral=2)


def test_frames_that_lack_markers_without_those_astray_are_interpolated_and_from_others_alone(
    actor: Actor, tmp_path: Path
) -> None:
    sites = place_markers(actor.rig, 12)
    sites.save(tmp_path / "sites.json")
    points = sites.on(actor.mesh.faces, actor.frames)
    points[7, 3] += 500.0
    points[2:7] = torch.nan
    save_take(Take(FPS, markers=Track(sites.labels or (), points)), tmp_path / "take.trc")
    found = coarse(actor, tmp_path / "take.trc", tmp_path, attachment=tmp_path / "sites.json")
    assert any("left out: 1, at worst M004 in frame 7 by 86" in line for line in found.notes)
    assert any("6 of 12 frames (the first 2) show fewer than 12 markers" in line for line in found.notes)
    assert float((found.read(0, FRAMES) - actor.frames).norm(dim=-1).max()) < 10

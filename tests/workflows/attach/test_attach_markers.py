"""Sites from a range of motion with faults are those of the same take without them."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface import Attachment, BlendshapeRig, Take, Track
from torchface.capture.markers.attachment.initial_sites import sites_by_shape
from torchface.errors import AlignmentError, ValueRangeError
from torchface.geometry.rotations import rotation_matrix
from torchface.io import save_rig, save_take
from torchface.synthetic import performer
from torchface.synthetic.stages.marker_stage import StageFlaws, place_markers, record
from torchface.workflows.attach.attach_markers import AttachSettings, attach, cleaned_fit, helmet_markers
from torchface.workflows.marker_input import MarkerOptions


@pytest.fixture(scope="module")
def motion(dome_rig: BlendshapeRig) -> tuple[Attachment, Take]:
    """Thirty sites on the dome, and what was recorded of them."""
    sites = place_markers(dome_rig, 30)
    weights = 0.5 + 0.5 * torch.sin(torch.arange(150)[:, None] / torch.tensor([7.0, 11, 5, 13]))
    return sites, record(dome_rig, sites, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.05)).take


@pytest.mark.parametrize(("pair", "share"), [((0, 20), 0.09), ((4, 11), 0.46), ((7, 29), 0.46)])
def test_labels_exchanged_in_less_than_half_move_no_site(
    dome_rig: BlendshapeRig, motion: tuple[Attachment, Take], pair: tuple[int, int], share: float
) -> None:
    sites, take = motion
    values = take.markers.values.clone()
    rows = slice(30, 30 + round(share * len(take)))
    values[rows, list(pair)] = values[rows, list(pair[::-1])]
    dirty = replace(take, markers=Track(take.markers.names, values))
    fit, cleanup = cleaned_fit(dome_rig, dirty, sites, standoff=False, free_scale=False)
    faces, rest = dome_rig.neutral.faces, dome_rig.vertices
    assert (fit.attachment.on(faces, rest) - sites.on(faces, rest)).norm(dim=-1).max() < 1.0
    labels = take.markers.names
    (swap,) = (defect for defect in cleanup.defects if defect.kind == "swap")
    assert (set(swap.labels), swap.first, swap.last) == ({labels[m] for m in pair}, rows.start, rows.stop - 1)


@pytest.mark.parametrize(("count", "seed"), [(1, 0), (4, 1)])
def test_markers_of_the_helmet_are_named_and_those_of_the_face_are_not(
    dome_rig: BlendshapeRig, motion: tuple[Attachment, Take], count: int, seed: int
) -> None:
    sites, take = motion
    generator = torch.Generator().manual_seed(seed)
    places = torch.tensor([0.0, 60.0, 110.0]) + 30 * torch.randn(count, 3, generator=generator)
    on_helmet = places + 0.05 * torch.randn(len(take), count, 3, generator=generator)
    names = [f"H{i}" for i in range(count)]
    values = torch.cat([take.markers.values, on_helmet], dim=1)
    whole = replace(take, markers=Track((*take.markers.names, *names), values))
    start = Attachment(
        torch.cat([sites.triangles, sites.triangles[:count]]),
        torch.cat([sites.barycentric, sites.barycentric[:count]]),
        (*(sites.labels or ()), *names),
    )
    fit, _ = cleaned_fit(dome_rig, whole, start, standoff=False, free_scale=False)
    assert helmet_markers(fit, whole, whole) == names
    alone, _ = cleaned_fit(dome_rig, take, sites, standoff=False, free_scale=False)
    assert helmet_markers(alone, take, take) == []


def test_markers_on_a_dome_are_found_on_it_by_their_shape(
    dome_rig: BlendshapeRig, motion: tuple[Attachment, Take]
) -> None:
    """No turn about the dome's axis and no size is determined: markers must not slide over its border."""
    sites, take = motion
    faces, rest = dome_rig.neutral.faces, dome_rig.vertices
    found = sites_by_shape(dome_rig, take)
    assert (found.on(faces, rest) - sites.on(faces, rest)).norm(dim=1).median() < 15


@pytest.mark.parametrize(
    ("moved", "by", "initial", "said"), [(1, 3.0, False, True), (1, 3.0, True, False), (5, 25.0, False, False)]
)
def test_markers_that_no_pose_explains_are_refused_with_the_flag_that_says_where_they_sit(
    dome_rig: BlendshapeRig,
    motion: tuple[Attachment, Take],
    tmp_path: Path,
    moved: int,
    by: float,
    initial: bool,
    said: bool,
) -> None:
    sites, take = motion
    values = take.markers.values[:40].clone()
    phase = torch.rand(1, values[:, ::moved].shape[1], 3, generator=torch.Generator().manual_seed(0))
    values[:, ::moved] += by * torch.sin(torch.arange(len(values))[:, None, None] / 3 + 6 * phase)
    save_rig(dome_rig, tmp_path / "rig.glb")
    save_take(Take(take.fps, markers=Track(take.markers.names, values)), tmp_path / "rom.c3d")
    sites.save(tmp_path / "sites.json")
    settings = AttachSettings(tmp_path / "sites.json" if initial else None)
    with pytest.raises((AlignmentError, ValueRangeError)) as refused:
        attach(tmp_path / "rig.glb", tmp_path / "rom.c3d", tmp_path / "out.json", settings)
    assert "lie nowhere" not in str(refused.value)
    assert ("--initial says it roughly" in str(refused.value)) == said
    assert not (tmp_path / "out.json").exists()
    if not said:
        return  # insisting is the same
    insisted = attach(tmp_path / "rig.glb", tmp_path / "rom.c3d", tmp_path / "out.json", replace(settings, insist=True))
    assert insisted.lines()[0] == insisted.verdict()
    assert insisted.verdict().startswith("result: poor, the markers lie ")


def test_a_head_that_moves_freely_in_the_volume_moves_no_site(tmp_path: Path) -> None:
    whole = performer(texture=False)
    rig = whole.select(["jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "noseSneerLeft"])
    sites = place_markers(rig, 40)
    weights = torch.rand(60, len(rig.names), generator=torch.Generator().manual_seed(0)).square()
    take = record(rig, sites, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.1, missing=0.02)).take
    phase = torch.arange(len(take)) / 12
    turned = rotation_matrix(0.7 * torch.stack([0.3 * phase.sin(), phase.cos(), 0 * phase], 1))
    walked = 1000 * torch.stack([phase.sin(), 1.5 + 0 * phase, phase.cos()], 1)
    save_rig(rig, tmp_path / "rig.glb")
    found = []
    for name, moved in (("still", False), ("freely", True)):
        values = take.markers.values
        values = values @ turned.transpose(1, 2) + walked[:, None] if moved else values
        save_take(replace(take, markers=Track(take.markers.names, values)), tmp_path / f"{name}.c3d")
        found.append(attach(tmp_path / "rig.glb", tmp_path / f"{name}.c3d", tmp_path / f"{name}.json"))
    still, freely = found
    faces, rest = rig.neutral.faces, rig.vertices
    apart = (still.fit.attachment.on(faces, rest) - freely.fit.attachment.on(faces, rest)).norm(dim=1)
    assert apart.max() < 0.3
    assert freely.warnings == still.warnings == ()
    assert freely.verdict().startswith("result: good, the markers lie 0.1")
    assert freely.cleanup.masked.sum() == 0
    # The motion is that of every frame: without it the markers lie on the sites, in the direction that undo gives.
    seen = freely.fit.alignment.apply((take.markers.values @ turned.transpose(1, 2) + walked[:, None]).double())
    off = freely.fit.motion.undo(seen) - sites.on(faces, rig(weights))
    assert off.norm(dim=-1).nanmedian() < 0.3
    assert freely.fit.motion.translation.norm(dim=1).max() > 1000
    assert 40 < freely.fit.motion.degrees().norm(dim=1).max() < 90


@pytest.mark.parametrize("sided", [True, False])
def test_a_mirrored_take_is_refused_by_the_sides_of_its_labels_and_else_said_to_look_the_same(
    tmp_path: Path, sided: bool
) -> None:
    rig = performer(texture=False).select(["jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight"])
    rows = rig.neutral.landmarks[[17, 21, 22, 26, 31, 35, 48, 54, 51, 57, 50, 52, 41, 46]]
    names = ["ROB", "RIB", "LIB", "LOB", "nose_r", "nose_l", "mouthRight", "mouthLeft", "UL", "LL", "p", "q", "s", "t"]
    labels = names if sided else [f"M{number}" for number in range(len(rows))]
    sites = Attachment.from_vertices(rig.neutral, rows, labels)
    weights = torch.rand(40, len(rig.names), generator=torch.Generator().manual_seed(0))
    take = record(rig, sites, weights, torch.Generator().manual_seed(0), StageFlaws(noise=0.1)).take
    mirrored = take.markers.values * torch.tensor([1.0, 1.0, -1.0])
    save_rig(rig, tmp_path / "rig.glb")
    save_take(replace(take, markers=Track(take.markers.names, mirrored)), tmp_path / "rom.c3d")
    out = tmp_path / "out.json"
    if sided:
        with pytest.raises(AlignmentError, match=r"LIB and RIB, .*the coordinates are left-handed \(--flip x\)"):
            attach(tmp_path / "rig.glb", tmp_path / "rom.c3d", out)
        flipped = AttachSettings(options=MarkerOptions(flip="x"), insist=True)
        assert not attach(tmp_path / "rig.glb", tmp_path / "rom.c3d", out, flipped).remarks
    else:
        (remark,) = attach(tmp_path / "rig.glb", tmp_path / "rom.c3d", out, AttachSettings(insist=True)).remarks
        assert "a take in left-handed axes looks the same" in remark

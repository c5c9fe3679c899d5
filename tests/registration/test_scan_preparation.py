"""Scans, templates and landmarks that cannot be right, and what is said of them."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchface.errors import AlignmentError, ShapeError, TopologyError, ValueRangeError
from torchface.geometry.mirrored_points import check_mirrored
from torchface.io import load_landmark_points
from torchface.mesh import Mesh
from torchface.registration import DEFAULT_SCHEDULE, Level, Schedule, Stage, register
from torchface.registration.scan_preparation import check_same_hand, one_side_notes, prepare_scan
from torchface.synthetic import neutral_head, performer


def test_an_empty_or_tiny_scan_is_refused(mask: Mesh) -> None:
    for count in (0, 12):
        with pytest.raises(TopologyError, match=rf"scan: found .* {count} triangles, expected .* at least 50"):
            register(mask, Mesh(mask.vertices, mask.faces[:count]))


def test_an_empty_template_is_refused(mask: Mesh) -> None:
    with pytest.raises(TopologyError, match="template: found 0 triangles"):
        register(Mesh(mask.vertices, mask.faces[:0]), mask)
    with pytest.raises(ValueRangeError, match="template: found no triangle with any area"):
        register(mask.with_vertices(mask.vertices * 0), mask)


def test_a_scan_without_area_is_refused(mask: Mesh) -> None:
    with pytest.raises(ValueRangeError, match="0 triangles with any area"):
        register(mask, mask.with_vertices(mask.vertices * 0))


def test_nan_never_gets_into_a_scan(mask: Mesh) -> None:
    broken = mask.vertices.clone()
    broken[7] = torch.nan
    with pytest.raises(ValueRangeError, match="1 of 1485 vertices are NaN"):
        register(mask, mask.with_vertices(broken))


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1e-3, r"in metres \(load with unit='m'; on the command line --unit m\)"),
        (0.1, "in centimetres .*unit='cm'"),
        (1e3, "read as metres"),
    ],
)
def test_another_unit_is_detected_and_said(mask: Mesh, factor: float, said: str) -> None:
    with pytest.raises(ValueRangeError, match=said):
        register(mask, mask.with_vertices(mask.vertices * factor))


def test_landmarks_of_the_wrong_form_are_refused(mask: Mesh) -> None:
    points = mask.vertices[mask.landmarks]
    with pytest.raises(ShapeError, match=r"expected template vertex ids \(L,\) int64 and scan points \(L,3\)"):
        register(mask, mask, (mask.landmarks, points[:5]))
    with pytest.raises(ShapeError, match="expected template vertex ids"):
        register(mask, mask, (mask.landmarks.float(), points))
    with pytest.raises(TopologyError, match="expected 0 to 1484"):
        register(mask, mask, (mask.landmarks + 1400, points))


def test_fewer_than_three_landmarks_are_refused(mask: Mesh) -> None:
    points = mask.vertices[mask.landmarks]
    with pytest.raises(ShapeError, match="found 2 that can be used of 2, expected at least 3"):
        register(mask, mask, (mask.landmarks[:2], points[:2]))
    lost = points.clone()
    lost[1:4] = torch.nan
    lost[4:7] += 500.0
    with pytest.raises(ShapeError, match=r"found 2 that can be used of 8 \(3 are NaN, 3 lie more than 15 mm off"):
        register(mask, mask, (mask.landmarks, lost))


@pytest.mark.parametrize(
    ("factor", "unit", "cure"), [(1e-3, "metres", "1000"), (0.1, "centimetres", "10"), (1e3, "millimetres", "0.001")]
)
def test_landmarks_in_another_unit_than_the_scan_are_refused(mask: Mesh, factor: float, unit: str, cure: str) -> None:
    points = mask.vertices[mask.landmarks] * factor
    words = rf"mm across, .* \S+ mm across, as points in {unit} beside a scan in .*: multiply them by {cure}$"
    with pytest.raises(ValueRangeError, match=words):
        register(mask, mask, (mask.landmarks, points))


def test_a_scan_of_one_side_of_the_face_is_said() -> None:
    head = performer(texture=False).neutral
    regions = head.annotations.regions
    (warning,) = one_side_notes(head, head.vertices[:, 0] > 0)
    parts = r"\d% of the brow \(100% at the left\), \d% of the lids \(100% at the left\), 0% of the cheek \(100% "
    assert re.match(f"warning: at the person's right the scan shows {parts}", warning), warning
    (warning,) = one_side_notes(head, ~regions["lids_left"])
    assert re.match("warning: at the person's left the scan shows 0% of the lids .*at the right.: the rest", warning)
    assert one_side_notes(head, torch.ones(len(head.vertices), dtype=torch.bool)) == []
    assert one_side_notes(head, ~regions["forehead"]) == []
    plain = replace(head, annotations=replace(head.annotations, regions={"face": regions["face"]}))  # ICT's template
    (warning,) = one_side_notes(plain, head.vertices[:, 0] < 0)
    assert re.match(
        r"warning: at the person's left the scan shows \d% of the face \((9\d|100)% at the right\)", warning
    )


@pytest.mark.parametrize(
    ("regions", "words"),
    [
        pytest.param(("nose", "nostrils"), "of the nose", marks=pytest.mark.bench),
        (("chin",), "of the chin"),
        pytest.param(("cheek_left", "cheek_right"), "of the cheeks", marks=pytest.mark.bench),
        pytest.param(("lids_left", "lids_right"), "of the eyes", marks=pytest.mark.bench),
        (("upper_lip", "lower_lip", "cheek_left"), "of the mouth"),
        (("forehead", "cheek_left", "lids_left"), ""),
    ],
)
def test_a_part_of_the_face_that_a_scan_lacks_makes_it_partly_usable(regions: tuple[str, ...], words: str) -> None:
    head = neutral_head(texture=False)
    lost = torch.stack([head.annotations.regions[name] for name in regions]).any(0)
    kept = head.faces[~lost[head.faces].any(1)]
    scan = Mesh(head.vertices, kept)
    marks, short = (head.landmarks, head.vertices[head.landmarks]), Schedule(DEFAULT_SCHEDULE.stages[:1])
    record = register(head, scan, marks, schedule=short, texture_size=0).record
    warnings = [note for note in record.notes if note.startswith("warning: the scan shows ")]
    assert len(warnings) == bool(words)
    assert all(re.fullmatch(rf"warning: the scan shows [0-4]?\d% {words}: the rest is a guess", w) for w in warnings)
    if words:
        assert record.verdict().startswith("result: partly usable")


def test_landmarks_on_a_line_are_refused(mask: Mesh, make_mask) -> None:
    flat = make_mask(9, 9)
    straight = flat.with_vertices(flat.vertices * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 1e-3]))
    ids = torch.tensor([4 * 9 + 1, 4 * 9 + 4, 4 * 9 + 7])
    with pytest.raises(ValueRangeError, match="lie on a line"):
        register(straight, mask, (ids, mask.vertices[[733, 741, 753]]))


def test_landmarks_in_another_order_are_refused(mask: Mesh) -> None:
    points = mask.vertices[mask.landmarks]
    with pytest.raises(AlignmentError, match="expected both in the same order"):
        register(mask, mask, (mask.landmarks, points[[3, 6, 0, 7, 2, 1, 5, 4]]))


@pytest.mark.parametrize("axis", [0, 2])
def test_a_mirrored_scan_is_told_by_its_landmarks(mask: Mesh, axis: int) -> None:
    flip = torch.ones(3, dtype=torch.float64)
    flip[axis] = -1
    scan = replace(mask, vertices=mask.vertices * flip, faces=mask.faces.flip(1))
    with pytest.raises(AlignmentError, match=r"mirror image.* scaled \d\d\.\d mm .*, mirrored as well \S+ mm are left"):
        register(mask, scan, (mask.landmarks, scan.vertices[mask.landmarks]))


@pytest.mark.real
@pytest.mark.parametrize("count", [5, 51, 68])
def test_a_real_scans_landmarks_tell_its_mirror_image(data: Path, count: int) -> None:
    template = performer(texture=False).neutral
    keep = torch.tensor({5: [30, 36, 45, 48, 54]}.get(count, list(range(68 - count, 68))))
    points = load_landmark_points(data / "scans" / "james" / "james.ljson").ibug()[keep].double()
    own = template.vertices[template.landmarks[keep]].double()
    check_same_hand(own, points)
    right = check_mirrored(own, points)
    assert right.mirrored_distance > 3 * right.distance
    with pytest.raises(AlignmentError, match="mirror image"):
        check_same_hand(own, points * torch.tensor([1.0, 1.0, -1.0]))


def test_a_template_of_another_size_is_noted(mask: Mesh) -> None:
    small = replace(mask, vertices=0.7 * mask.vertices)
    quick = replace(DEFAULT_SCHEDULE, stages=DEFAULT_SCHEDULE.stages[:1])
    notes = [
        " ".join(register(mask, scan, (mask.landmarks, scan.vertices[mask.landmarks]), schedule=quick).record.notes)
        for scan in (mask, small)
    ]
    assert "at 0.7 times its size" in notes[1]
    assert "times its size" not in notes[0]


def test_a_scan_of_something_else_where_the_landmarks_are_is_refused(mask: Mesh) -> None:
    """Landmarks on specks of surface, and nothing of the face around them."""
    picked = mask.vertices[mask.landmarks]
    speck = torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]]).double() @ torch.tensor(
        [[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]
    ).double()  # fmt: skip
    vertices = torch.cat([p + speck + 0.01 * k for p in picked for k in range(10)])
    scan = Mesh(vertices, torch.arange(len(vertices)).reshape(-1, 3))
    tight = Schedule((Stage(Level.GRAPH, 30.0, 10.0, 0.5),))
    with pytest.raises(ValueRangeError, match="correspondences stands the tests"):
        register(mask, scan, (mask.landmarks, picked), schedule=tight)


def test_vertices_written_once_a_triangle_are_joined(mask: Mesh) -> None:
    """STL and many exporters repeat a vertex for each triangle; without joining, everything were border."""
    soup = Mesh(mask.vertices[mask.faces.flatten()], torch.arange(mask.faces.numel()).reshape(-1, 3))
    prepared = prepare_scan(soup, mask)
    assert len(prepared.vertices) == len(mask.vertices)
    assert len(prepared.faces) == len(mask.faces)
    landmarks = (mask.landmarks, mask.vertices[mask.landmarks])
    result = register(mask, soup, landmarks)
    assert float((result.mesh.vertices - mask.vertices).norm(dim=1).max()) < 0.05


def test_only_small_loose_parts_are_dropped(mask: Mesh) -> None:
    half = mask.vertices * 0.5 + torch.tensor([200.0, 0.0, 0.0])
    small = mask.vertices * 0.05 + torch.tensor([0.0, 150.0, 0.0])
    count = len(mask.vertices)
    scan = Mesh(
        torch.cat([mask.vertices, half, small]), torch.cat([mask.faces, mask.faces + count, mask.faces + 2 * count])
    )
    prepared = prepare_scan(scan, mask)
    assert torch.equal(prepared.face_ids, torch.arange(2 * len(mask.faces)))
    assert prepared.notes == (
        f"1 loose parts of the scan ({len(mask.faces)} triangles, 0.2% of its area) were left out: such are dust, "
        "teeth, eyes",
    )


def test_the_outside_is_turned_out(mask: Mesh) -> None:
    assert prepare_scan(mask, mask).notes == ()
    turned = prepare_scan(Mesh(mask.vertices, mask.faces.flip(1)), mask)
    assert "flipped normals" in turned.notes[0]
    assert torch.equal(turned.vertices[turned.faces], prepare_scan(mask, mask).vertices[prepare_scan(mask, mask).faces])


def test_a_texture_size_that_cannot_be_is_refused(mask: Mesh) -> None:
    with pytest.raises(ShapeError, match="texture_size"):
        register(mask, mask, texture_size=-1)


def test_schedules_and_stages_check_themselves() -> None:
    with pytest.raises(ValueRangeError, match="stage: stiffness: found 0"):
        Stage(Level.GRAPH, 0.0, 1.0, 10.0)
    with pytest.raises(ValueRangeError, match="found no stages"):
        Schedule(())

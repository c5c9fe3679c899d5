"""Landmark files of menpo, iBUG and the toolkit's own."""

import json
from pathlib import Path

import pytest
import torch
from mutation import check_reader

from torchface.errors import FileFormatError, NameMismatchError, ShapeError, ValueRangeError
from torchface.io.landmarks.landmark_points import LandmarkPoints, load_landmark_points, save_pts
from torchface.io.landmarks.picks import Correspondences, save_correspondences

GROUPS = {"chin": 17, "leye": 6, "reye": 6, "leyebrow": 5, "nose": 9, "reyebrow": 5, "mouth": 20}


def ljson(points: list, labels: list | None = None) -> dict:
    return {"version": 3, "groups": {"LJSON": {"labels": labels or [], "landmarks": {"points": points}}}}


def save(path: Path, document: object) -> Path:
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


@pytest.fixture
def sixty_eight(tmp_path: Path) -> Path:
    labels, first = [], 0
    for name, count in GROUPS.items():
        labels.append({"label": name, "mask": list(range(first, first + count))})
        first += count
    return save(tmp_path / "head.ljson", ljson([[i, 2.0 * i, -i] for i in range(68)], labels))


def test_ljson_points_and_groups_are_read(sixty_eight: Path) -> None:
    found = load_landmark_points(sixty_eight)
    assert found.points.dtype == torch.float64
    assert torch.equal(found.points[:, 1], 2 * torch.arange(68.0).double())
    assert found.groups["nose"].tolist() == list(range(34, 43))


def test_menpos_groups_come_in_ibugs_order(sixty_eight: Path) -> None:
    order = load_landmark_points(sixty_eight).ibug()[:, 0].long().tolist()
    chin, brows, nose = list(range(17)), [*range(29, 34), *range(43, 48)], list(range(34, 43))
    assert order == [*chin, *brows, *nose, *range(17, 29), *range(48, 68)]


def test_other_sets_are_not_taken_for_ibugs(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="found 2, expected 68"):
        LandmarkPoints(torch.zeros(2, 3)).ibug()
    labels = [{"label": "ear", "mask": [0]}]
    other = load_landmark_points(save(tmp_path / "ear.ljson", ljson([[0, 0, 0]], labels)))
    with pytest.raises(NameMismatchError, match=r"ear\.ljson: found the groups ear, expected jaw, left_eyebrow"):
        other.ibug()


@pytest.mark.parametrize("version", [1, 2, 3])
def test_menpos_labels_of_today_come_in_ibugs_order(tmp_path: Path, version: int) -> None:
    sizes = {"mouth": 20, "left_eye": 6, "jaw": 17, "right_eye": 6, "nose": 9, "right_eyebrow": 5, "left_eyebrow": 5}
    firsts, labels = {}, [{"label": "inner", "mask": [0, 3]}]
    for name, count in sizes.items():
        firsts[name] = sum(map(len, (one["mask"] for one in labels[1:])))
        labels.append({"label": name, "mask": list(range(firsts[name], firsts[name] + count))})
    points = [[float(i), 2.0 * i, -1.0 * i] for i in range(68)]
    document: dict = ljson(points, labels)
    if version == 2:
        document = {"version": 2, "labels": labels, "landmarks": {"points": points}}
    if version == 1:
        sets = [
            {"label": one["label"], "landmarks": [{"point": points[row]} for row in one["mask"]]} for one in labels[1:]
        ]
        document = {"version": 1, "groups": sets}
    order = load_landmark_points(save(tmp_path / "a.ljson", document)).ibug()[:, 0].long().tolist()
    names = ("jaw", "left_eyebrow", "right_eyebrow", "nose", "left_eye", "right_eye", "mouth")
    assert order == [row for name in names for row in range(firsts[name], firsts[name] + sizes[name])]


def test_menpos_all_alone_leaves_the_files_order(tmp_path: Path) -> None:
    document = ljson([[i, i, i] for i in range(68)], [{"label": "all", "mask": list(range(68))}])
    assert load_landmark_points(save(tmp_path / "a.ljson", document)).ibug()[:, 0].tolist() == list(range(68))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"jaw": range(16)}, "found 16 points under 'jaw', expected iBUG's 17"),
        ({"nose": range(31, 40)}, "found points that belong to two of the groups"),
        ({"mouth": None}, r"expected jaw, .* \(none for mouth\)"),
    ],
)
def test_groups_that_do_not_fit_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    masks: dict = {
        "jaw": range(17),
        "left_eyebrow": range(17, 22),
        "right_eyebrow": range(22, 27),
        "nose": range(27, 36),
        "left_eye": range(36, 42),
        "right_eye": range(42, 48),
        "mouth": range(48, 68),
    }
    masks = {name: list(rows) for name, rows in (masks | change).items() if rows is not None}
    labels = [{"label": name, "mask": rows} for name, rows in masks.items()]
    found = load_landmark_points(save(tmp_path / "head.ljson", ljson([[i, i, i] for i in range(68)], labels)))
    with pytest.raises((ShapeError, NameMismatchError), match=r"head\.ljson: .*" + message):
        found.ibug()


def test_missing_points_are_nan_and_flat_ones_turn_from_row_column_to_x_y(tmp_path: Path) -> None:
    found = load_landmark_points(save(tmp_path / "a.ljson", ljson([[10, 20], [None, None]])))
    assert found.points[0].tolist() == [20, 10]
    assert found.points[1].isnan().all()


def test_older_versions_are_read(tmp_path: Path) -> None:
    second = {"version": 2, "labels": [{"label": "tip", "mask": [1]}], "landmarks": {"points": [[1, 2, 3], [4, 5, 6]]}}
    first = {
        "version": 1,
        "groups": [
            {"label": "root", "landmarks": [{"point": [1, 2, 3]}]},
            {"label": "tip", "landmarks": [{"point": [4, 5, 6]}]},
        ],
    }
    for name, document in (("two.ljson", second), ("one.ljson", first)):
        found = load_landmark_points(save(tmp_path / name, document))
        assert found.points.tolist() == [[1, 2, 3], [4, 5, 6]]
        assert found.groups["tip"].tolist() == [1]


def test_pts_counts_pixels_from_one(tmp_path: Path) -> None:
    text = "version: 1\nn_points:  2\n{\n611.28 272.77\n1 1\n}\n"
    found = load_landmark_points(save(tmp_path / "face.pts", text))
    assert torch.allclose(found.points, torch.tensor([[610.28, 271.77], [0, 0]]).double())


def test_pts_come_back_as_they_were_written(tmp_path: Path) -> None:
    points = 200 * torch.rand(68, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 20
    save_pts(points, tmp_path / "face.pts")
    text = (tmp_path / "face.pts").read_text().splitlines()
    assert text[:3] == ["version: 1", "n_points: 68", "{"]
    assert float(text[3].split()[0]) == pytest.approx(float(points[0, 0]) + 1, abs=6e-4)  # iBUG counts from 1
    torch.testing.assert_close(load_landmark_points(tmp_path / "face.pts").points, points, atol=6e-4, rtol=0)
    points[3] = torch.nan
    with pytest.raises(ValueRangeError, match="NaN"):
        save_pts(points, tmp_path / "other.pts")
    with pytest.raises(ShapeError, match=r"expected \(L,2\)"):
        save_pts(torch.zeros(68, 3), tmp_path / "other.pts")
    assert not (tmp_path / "other.pts").exists()


def test_pts_of_three_dimensions_are_positions(tmp_path: Path) -> None:
    text = "version: 1\nn_points: 1\n{\n1 2 3\n}\n"
    assert load_landmark_points(save(tmp_path / "face.pts", text)).points.tolist() == [[1, 2, 3]]


def test_own_correspondences_give_their_scan_points(tmp_path: Path) -> None:
    points = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    save_correspondences(Correspondences(torch.tensor([5, 9]), points, ("a", "b")), tmp_path / "pairs.json")
    assert torch.allclose(load_landmark_points(tmp_path / "pairs.json").points.double(), points.double())


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.txt", "1 2", "found the ending '.txt'"),
        ("a.ljson", "{", "not JSON"),
        ("a.ljson", "[]", '"version" of 1, 2 or 3'),
        ("a.ljson", json.dumps({"version": 9}), '"version" of 1, 2 or 3'),
        ("a.ljson", json.dumps({"version": 3, "groups": {}}), "found 0 sets"),
        ("a.ljson", json.dumps(ljson([])), "two- or three-dimensional"),
        ("a.ljson", json.dumps(ljson([[1, 2, 3], [1, 2]])), "different width"),
        ("a.ljson", json.dumps(ljson([[1, 2, "x"]])), "no numbers"),
        ("a.ljson", '{"version": 2, "landmarks": {"points": [[1, 2, 1e999]]}}', "infinite"),
        ("a.ljson", json.dumps(ljson([[1, 2, 3]], [{"label": "x", "mask": [1]}])), "rows outside 0 to 0"),
        ("a.pts", "1 2\n3 4\n", "no points between braces"),
        ("a.pts", "n_points: 3\n{\n1 2\n}\n", "found 1 points, expected the n_points: 3"),
        ("a.pts", "n_points: 1\n{\n1 two\n}\n", "found text among the points"),
        ("a.pts", "n_points: 2\n{\n1 2\n1 2 3\n}\n", "different width"),
    ],
)
def test_broken_files_say_what_is_wrong(tmp_path: Path, name: str, content: str, said: str) -> None:
    with pytest.raises(FileFormatError, match=said) as caught:
        load_landmark_points(save(tmp_path / name, content))
    assert name in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"none\.ljson"):
        load_landmark_points(tmp_path / "none.ljson")


def test_mutated_landmark_files_are_read_or_refused(tmp_path: Path, sixty_eight: Path) -> None:
    pts = save(tmp_path / "face.pts", "version: 1\nn_points:  3\n{\n611.28 272.77\n1 1\n5.5 1e2\n}\n")
    check_reader(load_landmark_points, [sixty_eight], ".ljson")
    check_reader(load_landmark_points, [pts], ".pts")


@pytest.mark.real
def test_real_files_are_read(data: Path) -> None:
    head = load_landmark_points(data / "scans" / "james" / "james.ljson").ibug()
    assert head.shape == (68, 3)
    nose, chin, right_eye, left_eye = head[30], head[8], head[36:42].mean(0), head[42:48].mean(0)
    assert float(right_eye[0]) < float(nose[0]) < float(left_eye[0])
    assert float(chin[1]) < float(nose[1]) < float(right_eye[1])
    (picture,) = (data / "images" / "ibug").glob("*.pts")
    assert load_landmark_points(picture).ibug().shape == (68, 2)

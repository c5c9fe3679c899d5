"""A planted camera comes back from pictures of a checkerboard, and useless images are refused by name."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.cli import main
from torchface.errors import AlignmentError, FileFormatError, ShapeError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import distort, undistort
from torchface.geometry.rotations import rotation_matrix, rotation_vector
from torchface.io import load_calibration, load_cameras, load_image, save_image
from torchface.io.video import write_video
from torchface.progress import silent
from torchface.workflows.calibrate_beside import calibrate_beside
from torchface.workflows.calibrate_camera import Board, View, calibrate, calibrate_views, find_boards, find_corners

BOARD = Board(7, 5, 25.0)
K = torch.tensor([[520.0, 0, 310.5], [0, 524, 247.2], [0, 0, 1]], dtype=torch.float64)
TRUE = CameraCalibration(K, torch.tensor([-0.22, 0.06, 0.001, -0.0008, 0.0]).double(), 640, 480)
TURNS = (
    (0.1, 0.05, 0.15),
    (0.45, 0.1, 0.1),
    (-0.4, 0.2, -0.2),
    (0.1, 0.5, 0.05),
    (0.05, -0.5, 0.3),
    (0.35, 0.35, -0.1),
    (-0.35, -0.3, 0.2),
    (0.2, -0.2, 1.0),
)
PLACES = ((0, 0), (-75, -45), (75, -45), (-75, 45), (75, 45), (0, 50), (0, -50), (40, 10))


@pytest.fixture(scope="module")
def rays() -> Tensor:
    """Directions of the viewing rays, (960,1280,3): two samples a pixel side."""
    # Distortion is smooth: at every fourth pixel, and between them linear.
    x, y = torch.meshgrid(torch.linspace(-0.25, 639.25, 161), torch.linspace(-0.25, 479.25, 121), indexing="xy")
    coarse = undistort(torch.stack([x, y], dim=-1).double(), TRUE).permute(2, 0, 1)[None]
    ideal = torch.nn.functional.interpolate(coarse, (960, 1280), mode="bilinear", align_corners=True)[0]
    return torch.nn.functional.pad(ideal.permute(1, 2, 0), (0, 1), value=1.0) @ torch.linalg.inv(K).T


def seen_corners(turn: Sequence[float], place: Sequence[float]) -> Tensor:
    """Where the board's corners are seen, (35,2)."""
    rotation = rotation_matrix(torch.tensor(turn, dtype=torch.float64))
    points = BOARD.points.double()
    at = (points - points.mean(0)) @ rotation.T + torch.tensor([*place, 420.0], dtype=torch.float64)
    return distort((at @ K.T)[:, :2] / at[:, 2:], TRUE)


def filmed(rays: Tensor, turn: Sequence[float], place: Sequence[float], far: float = 420.0) -> Tensor:
    """A picture uint8 (480,640) of the board, turned and moved off the line of sight, on a grey wall."""
    rotation = rotation_matrix(torch.tensor(turn, dtype=torch.float64))
    middle = BOARD.points.double().mean(0)
    translation = torch.tensor([*place, far], dtype=torch.float64) - rotation @ middle
    # Where the rays meet the board's plane, in squares from its first inner corner.
    normal = rotation[:, 2]
    depth = (translation @ normal) / (rays @ normal)
    at = ((rays * depth[..., None] - translation) @ rotation)[..., :2] / BOARD.square
    squares = torch.tensor([BOARD.columns, BOARD.rows])
    paper = ((at > -2) & (at < squares + 1)).all(-1)
    board = ((at > -1) & (at < squares)).all(-1)
    dark = board & ((at.floor().sum(-1) % 2) == 0)
    light = torch.where(dark, 0.08, torch.where(paper, 0.92, 0.45))
    image = light.reshape(480, 2, 640, 2).mean((1, 3))
    noise = 0.01 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    return ((image + noise).clamp(0, 1) * 255).round().to(torch.uint8)


@pytest.fixture(scope="module")
def pictures(rays: Tensor) -> list[Tensor]:
    return [filmed(rays, turn, place) for turn, place in zip(TURNS, PLACES, strict=True)]


def save(images: Sequence[Tensor], folder: Path) -> list[Path]:
    paths = [folder / f"board_{i}.png" for i in range(len(images))]
    for path, image in zip(paths, images, strict=True):
        save_image(image.float().div(255).expand(3, -1, -1), path)
    return paths


def test_a_planted_camera_comes_back(
    pictures: list[Tensor], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = torch.full((480, 640), 120, dtype=torch.uint8)
    paths = save([*pictures, empty, pictures[2]], tmp_path)
    out = tmp_path / "camera.toml"
    main(["calibrate", *map(str, paths), "--corners", "7x5", "--square", "25", "--out", str(out), "--quiet"])
    told = capsys.readouterr()
    assert told.out.split() == [str(tmp_path / "camera.png"), str(out)]
    assert "8 of 10 views used, 640 x 480 pixels" in told.err
    assert "left out board_8.png: no board of 7 x 5 inner corners" in told.err
    assert "left out board_9.png: the board stands as in board_2.png" in told.err
    found = load_calibration(out)
    assert (found.width, found.height, found.assumed) == (640, 480, False)
    assert found.error < 0.1
    torch.testing.assert_close(found.intrinsics.diagonal(), K.diagonal(), rtol=0.005, atol=0)
    torch.testing.assert_close(found.intrinsics[:2, 2], K[:2, 2], rtol=0, atol=2.0)
    torch.testing.assert_close(found.distortion[:4], TRUE.distortion[:4], rtol=0.1, atol=0.02)
    # What distortion does to pixels agrees over the image, whatever each coefficient is.
    x, y = torch.meshgrid(torch.linspace(20, 620, 9), torch.linspace(20, 460, 7), indexing="xy")
    grid = torch.stack([x, y], dim=-1).double()
    assert float((undistort(grid, found) - undistort(grid, TRUE)).norm(dim=-1).max()) < 2.0
    shown = load_image(tmp_path / "camera.png")
    assert shown.shape[2] > 4 * 400
    assert float(shown.std()) > 0.1


def test_corners_are_found_to_a_tenth_of_a_pixel(rays: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    image, true = filmed(rays, TURNS[7], PLACES[7]), seen_corners(TURNS[7], PLACES[7])
    found = find_corners(image, BOARD)
    # Turned by half a turn the board looks the same.
    off = torch.minimum((found - true).norm(dim=1), (found - true.flip(0)).norm(dim=1))
    assert float(off.mean()) < 0.1
    large = torch.nn.functional.interpolate(image[None, None].float(), scale_factor=2, mode="bicubic")
    # Large pictures are searched smaller and refined at their own size.
    monkeypatch.setattr("torchface.workflows.calibrate_camera._DETECTED_AT", 640)
    big = find_corners(large[0, 0].clamp(0, 255).to(torch.uint8), BOARD)
    torch.testing.assert_close((big + 0.5) / 2 - 0.5, found, rtol=0, atol=0.3)


def test_a_video_will_do(pictures: list[Tensor], tmp_path: Path, messages_of: Callable[..., str]) -> None:
    video = write_video(iter(pictures[:6]), tmp_path / "boards.avi", 10.0)
    out = tmp_path / "camera.toml"
    assert "6 of 6 views used" in messages_of("calibrate", video.path, "--corners", "7x5", "--out", out, "--quiet")
    torch.testing.assert_close(load_calibration(out).intrinsics.diagonal(), K.diagonal(), rtol=0.01, atol=0)


@pytest.mark.bench
def test_two_cameras_are_put_where_they_are(
    rays: Tensor, pictures: list[Tensor], tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    """The second one stands 60 mm to the right and is turned to the board."""
    turn, stand = rotation_matrix(torch.tensor([[0.0, 0.14, 0.01]]).double())[0], torch.tensor([60.0, 4, -5]).double()
    seen = []
    for vector, place in zip(TURNS, PLACES, strict=True):
        middle = turn @ (torch.tensor([*place, 420.0]).double() - stand)
        board = rotation_vector((turn @ rotation_matrix(torch.tensor([vector]).double())[0])[None])[0].tolist()
        seen.append(filmed(rays, board, middle[:2].tolist(), float(middle[2])))
    films = [
        str(write_video(iter(shown), tmp_path / f"{name}.avi", 10.0).path)
        for name, shown in (("left", pictures), ("right", seen))
    ]
    out = tmp_path / "rig.toml"
    assert "right: 60." in messages_of(
        "calibrate", films[0], "--beside", films[1], "--corners", "7x5", "--out", out, "--quiet"
    )
    right = load_cameras(out)[1]
    assert right.name == "right"
    torch.testing.assert_close(right.rotation, turn, atol=6e-3, rtol=0)
    torch.testing.assert_close(-right.rotation.T @ right.translation, stand, atol=1.0, rtol=0)
    with pytest.raises(AlignmentError, match="the board in 2 views"):
        calibrate_beside([Path(films[0]), write_video(iter(seen[:2]), tmp_path / "short.avi", 10.0).path], BOARD, out)
    late = write_video(iter([*seen[3:], *seen[:3]]), tmp_path / "late.avi", 10.0).path
    with pytest.raises(AlignmentError, match=r"no place of late\.avi beside left\.avi"):
        calibrate_beside([Path(films[0]), late], BOARD, out)


def test_useless_pictures_are_refused(pictures: list[Tensor]) -> None:
    blank = torch.zeros(480, 640, dtype=torch.uint8)

    def view(name: str, turn: Sequence[float], place: Sequence[float], off: float = 0.05) -> View:
        generator = torch.Generator().manual_seed(sum(map(ord, name)))
        return View(name, blank, (seen_corners(turn, place) + off * torch.randn(35, 2, generator=generator)).float())

    views = [view(str(i), turn, place) for i, (turn, place) in enumerate(zip(TURNS, PLACES, strict=True))]
    with pytest.raises(AlignmentError, match=r"board in 4 views, expected 5 .*wall.png: no board"):
        calibrate_views(views[:4], BOARD, [("wall.png", "no board of 7 x 5 inner corners")])
    parallel = [view(str(i), (0, 0, 0.1 * i), place) for i, place in enumerate(PLACES)]
    with pytest.raises(AlignmentError, match=r"tilted by at most .* degrees|focal length open"):
        calibrate_views(parallel, BOARD)
    bent = view("bent.png", TURNS[1], (10, 30), off=5.0)
    report = calibrate_views([*views, bent], BOARD)
    assert [name for name, _ in report.left_out] == ["bent.png"]
    assert "pixels from where" in report.left_out[0][1]
    with pytest.raises(ShapeError, match="found b with 600 x 480 pixels and a with 640 x 480"):
        find_boards(iter([("a", pictures[0]), ("b", pictures[1][:, :600])]), BOARD, silent)


def test_bad_words(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    def refused(*words: str) -> str:
        return messages_of("calibrate", *words, "--quiet", status=2)

    picture = str(save([torch.zeros(48, 64, dtype=torch.uint8)], tmp_path)[0])
    assert "expected columns x rows such as 9x6" in refused(picture, "--corners", "nine")
    assert "expected .toml" in refused(picture, "--out", str(tmp_path / "camera.json"))
    (tmp_path / "file").write_text("no folder")
    assert "expected a folder" in refused(picture, "--out", str(tmp_path / "file" / "camera.toml"))
    refused(picture, "--out", str(tmp_path / "no" / "camera.toml"))
    assert not (tmp_path / "no").exists()
    assert "board in 0 views" in refused(picture, "--out", str(tmp_path / "camera.toml"))
    assert "found a video beside 1 files" in refused(picture, "a.mp4", "--out", str(tmp_path / "camera.toml"))
    assert not (tmp_path / "camera.toml").exists()
    with pytest.raises(ValueRangeError, match="3 to 100 inner corners"):
        Board(2, 6)
    with pytest.raises(FileFormatError, match="found no image"):
        calibrate([], BOARD, tmp_path / "camera.toml")


def test_a_picture_of_the_users_is_refused_before_any_view_is_read(tmp_path: Path) -> None:
    tmp_path.joinpath("camera.png").write_bytes(b"the user's")
    with pytest.raises(FileFormatError, match=r"camera\.png: found a file where camera\.toml keeps a part of its own"):
        calibrate([tmp_path / "missing.png"], BOARD, tmp_path / "camera.toml")

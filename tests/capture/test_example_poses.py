"""Retargeting learned from example poses: planted maps come back, names decide what no pose shows."""

from pathlib import Path

import pytest
import torch
from scipy.optimize import nnls

from torchface.capture.example_poses import ExamplePose, learn_shape_rules, load_example_poses
from torchface.capture.retargeting import load_shape_rules, save_shape_rules, shape_map
from torchface.errors import FileFormatError, NameMismatchError, TorchfaceError, ValueRangeError
from torchface.shape_names import ARKIT

NAMES = tuple(f"Creature{i}" for i in range(12))


def planted(sources: int = 8) -> tuple[torch.Tensor, list[ExamplePose]]:
    """A sparse map of the first sources, and random poses of several at once."""
    generator = torch.Generator().manual_seed(1)
    factors = torch.zeros(12, len(ARKIT), dtype=torch.float64)
    for row in factors:
        row[torch.randperm(sources, generator=generator)[:2]] = torch.rand(2, generator=generator).double() * 0.4 + 0.1
    poses = []
    for number in range(10):
        x = torch.rand(sources, generator=generator).double() * (torch.rand(sources, generator=generator) < 0.5)
        x[number % sources] = 1.0
        source = {ARKIT[i]: float(weight) for i, weight in enumerate(x) if weight > 0}
        y = factors[:, :sources] @ x
        poses.append(ExamplePose(f"pose {number}", source, {NAMES[i]: min(float(v), 1.0) for i, v in enumerate(y)}))
    return factors, poses


def test_a_planted_map_comes_back_sparse_and_in_range() -> None:
    factors, poses = planted()
    learned = learn_shape_rules(poses, ARKIT, NAMES)
    found = shape_map(ARKIT, NAMES, learned.rules)
    assert (found.matrix - factors).abs().max() < 5e-3
    assert (found.matrix > 0).sum() == 24
    assert (learned.found - learned.wanted).abs().max() < 5e-3
    weights = 3 * torch.rand(50, len(ARKIT), generator=torch.Generator().manual_seed(2))
    assert (found(weights) >= 0).all()
    assert (found(weights) <= 1).all()
    for row in range(3):  # scipy's least squares of the same poses
        peer, _ = nnls(learned.poses[:, :8].numpy(), learned.wanted[:, row].numpy())
        assert torch.allclose(found.matrix[row, :8].double(), torch.from_numpy(peer), atol=5e-3)


def test_names_decide_what_no_pose_shows() -> None:
    target = ("jawOpen", "mouthSmile_L", "mouthSmile_R", "Cheek")
    poses = [ExamplePose("smile", {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0}, {"mouthSmile_L": 0.8, "Cheek": 0.4})]
    learned = learn_shape_rules(poses, ARKIT, target)
    assert set(learned.rules) == {"mouthSmile_L", "mouthSmile_R", "Cheek"}
    (line,) = learned.notes
    assert line.startswith("mouthSmileLeft, mouthSmileRight are on only together")
    weights = torch.zeros(2, len(ARKIT))
    weights[0, [ARKIT.index("jawOpen"), ARKIT.index("mouthSmileLeft")]] = torch.tensor([0.5, 1.0])
    weights[1, [ARKIT.index("mouthSmileLeft"), ARKIT.index("mouthSmileRight")]] = 1.0
    found = shape_map(ARKIT, target, learned.rules)(weights)
    assert found[0, 0] == 0.5  # by its name
    assert found[0, 1] > 0.7  # its own side, by its name
    torch.testing.assert_close(found[1], torch.tensor([0.0, 0.8, 0.0, 0.4]), atol=5e-3, rtol=0)  # the pose is complete


def test_sides_that_poses_show_together_drive_their_own_and_those_of_other_poses_the_other() -> None:
    target = ("cheekSquint_L", "cheekSquint_R", "Corner_L")
    smile = {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0}
    poses = [
        ExamplePose("smile", smile, {"cheekSquint_L": 0.4, "cheekSquint_R": 0.4}),
        ExamplePose("frown", {"mouthFrownRight": 1.0}, {"Corner_L": 0.5}),
    ]
    rules = learn_shape_rules(poses, ARKIT, target).rules
    assert rules["cheekSquint_L"].sum == pytest.approx({"cheekSquintLeft": 1.0, "mouthSmileLeft": 0.4}, abs=1e-3)
    assert rules["cheekSquint_R"].sum == pytest.approx({"cheekSquintRight": 1.0, "mouthSmileRight": 0.4}, abs=1e-3)
    assert rules["Corner_L"].sum == pytest.approx({"mouthFrownRight": 0.5}, abs=1e-3)


def test_poses_and_what_is_learned_are_files(tmp_path: Path) -> None:
    (tmp_path / "poses.toml").write_text(
        "[smile]\nfrom = {mouthSmileLeft = 1.0}\nto = {Creature0 = 0.8, Creature1 = 0.3}\n"
        "[open]\nfrom = {jawOpen = 0.5}\nto = {Creature2 = 0.5}\n"
    )
    (tmp_path / "poses.csv").write_text(
        "pose,from:mouthSmileLeft,from:jawOpen,to:Creature0,to:Creature1,to:Creature2\nsmile,1,,0.8,0.3,\nopen,,0.5,,,0.5\n"
    )
    poses = load_example_poses(tmp_path / "poses.toml")
    assert poses == load_example_poses(tmp_path / "poses.csv")
    learned = learn_shape_rules(poses, ARKIT, NAMES)
    save_shape_rules(learned.rules, tmp_path / "table.toml")
    again = shape_map(ARKIT, NAMES, load_shape_rules(tmp_path / "table.toml"))
    torch.testing.assert_close(again(learned.poses), learned.found)


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("[smile]\nfrom = {jawOpen = 1}\n", "poses.toml", "expected a table"),
        ("[smile]\nfrom = {jawOpen = 'x'}\nto = {Creature0 = 1}\n", "poses.toml", "expected a weight"),
        ("[smile]\nfrom = 3\nto = {}\n", "poses.toml", "smile.from = 3, expected a table"),
        ("pose,from:jawOpen,Creature0\na,1,1\n", "poses.csv", "found the column 'Creature0'"),
        ("from:jawOpen,to:Creature0\n1,1\n", "poses.csv", "found no column 'pose'"),
    ],
)
def test_other_files_are_refused(text: str, name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FileFormatError, match=message):
        load_example_poses(tmp_path / name)


@pytest.mark.parametrize(
    ("poses", "error", "message"),
    [
        ([], ValueRangeError, "found none"),
        ([ExamplePose("a", {}, {"Creature0": 1.0})], ValueRangeError, "'a': found no weight of the source"),
        ([ExamplePose("a", {"jawOpen": 50.0}, {"Creature0": 1.0})], ValueRangeError, "jawOpen = 50, expected"),
        ([ExamplePose("a", {"jawOpenn": 1.0}, {})], NameMismatchError, "found 'jawOpenn', expected.*jawOpen"),
        ([ExamplePose("a", {"jawOpen": 1.0}, {"Creature99": 1.0})], NameMismatchError, "shapes of the character"),
    ],
)
def test_other_poses_are_refused(poses: list[ExamplePose], error: type[TorchfaceError], message: str) -> None:
    with pytest.raises(error, match=message):
        learn_shape_rules(poses, ARKIT, NAMES)

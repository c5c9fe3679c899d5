import math

import pytest
import torch

from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.shape_names import ARKIT
from torchface.take import Take, Track
from torchface.viz.browser.rig_viewer import GROUPS, grouped
from torchface.viz.browser.weight_editor import WeightEditor

NAMES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp")


def random_weights(frames: int = 40) -> torch.Tensor:
    return torch.rand(frames, len(NAMES), generator=torch.Generator().manual_seed(3))


def test_every_arkit_shape_is_in_one_group_and_twins_stand_together() -> None:
    groups = grouped(ARKIT)
    assert list(groups) == list(GROUPS)
    assert sorted(row for rows in groups.values() for row in rows) == list(range(52))
    sizes = {group: len(rows) for group, rows in groups.items()}
    assert sizes == {"brows": 5, "eyes": 14, "jaw": 4, "mouth": 23, "cheeks": 3, "nose": 2, "other": 1}
    mouth = [ARKIT[row] for row in groups["mouth"]]
    assert mouth.index("mouthSmileRight") == mouth.index("mouthSmileLeft") + 1


def test_symmetric_edit_sets_the_twin_and_nothing_else() -> None:
    weights = random_weights(1)
    editor = WeightEditor(NAMES, weights, symmetric=True)
    assert editor.set("mouthSmileRight", 0.75) == ("mouthSmileLeft", "mouthSmileRight")
    assert editor.pose.tolist() == [weights[0, 0], 0.75, 0.75, weights[0, 3]]
    assert editor.set("jawOpen", 0.5) == ("jawOpen",)
    editor.symmetric = False
    assert editor.set("mouthSmileLeft", 0.25) == ("mouthSmileLeft",)
    assert editor.pose.tolist() == [0.5, 0.25, 0.75, weights[0, 3]]


def test_a_maya_rig_has_its_groups_and_twins_and_a_jaw_is_not_pulled_both_ways() -> None:
    names = ("hero_bs.L_mouthSmile", "hero_bs.R_mouthSmile", "hero_bs.L_jaw", "hero_bs.R_jaw", "hero_bs.lf_eye_blink")
    assert grouped(names) == {"eyes": [4], "jaw": [2, 3], "mouth": [0, 1]}
    editor = WeightEditor(names, symmetric=True)
    assert editor.set(names[1], 0.5) == names[:2]
    assert editor.set(names[2], 0.5) == names[2:3]  # with its twin the face would stay where it is


def test_an_edit_takes_its_neighbours_along_by_a_raised_cosine() -> None:
    editor = WeightEditor(NAMES, torch.full((21, 4), 0.25), spread=4)
    editor.frame = 10
    editor.set("jawOpen", 0.75)
    expected = [0.25 + 0.5 * max(0.0, 0.5 * (1 + math.cos(math.pi * min(abs(f - 10), 5) / 5))) for f in range(21)]
    torch.testing.assert_close(editor.weights[:, 0], torch.tensor(expected))
    assert (editor.weights[:, 1:] == 0.25).all()
    editor.frame = 0  # the window is cut off at the take's ends
    editor.set("jawOpen", 0.0)
    assert editor.weights[0, 0] == 0
    assert len(editor) == 21


def test_neighbours_stay_between_the_sliders_ends() -> None:
    weights = torch.zeros(9, 4)
    weights[:, 0] = torch.tensor([0.9, 0.95, 1.0, 0.9, 0.0, 0.9, 1.0, 0.95, 0.9])
    editor = WeightEditor(NAMES, weights, spread=3)
    editor.frame = 4
    editor.set("jawOpen", 1.0)
    assert editor.weights.max() == 1.0
    assert editor.high.tolist() == [1, 1, 1, 1]
    assert WeightEditor(NAMES, torch.tensor([[-0.5, 0, 0, 1.5]])).low[0] == -0.5


def test_reset_gives_back_what_was_loaded_bit_by_bit() -> None:
    weights = random_weights()
    editor = WeightEditor(NAMES, weights, spread=5, symmetric=True)
    editor.frame = 17
    editor.set("mouthSmileLeft", 1.0)
    editor.rest()
    assert not torch.equal(editor.weights, weights)
    assert (editor.pose == 0).all()
    editor.reset_frame()
    assert torch.equal(editor.pose, weights[17])
    editor.reset()
    assert torch.equal(editor.weights, weights)


def test_active_shapes_are_listed_largest_first() -> None:
    editor = WeightEditor(NAMES, torch.tensor([[0.2, 0.005, -0.4, 0.0]]))
    assert [name for name, _ in editor.active()] == ["mouthSmileRight", "jawOpen"]


def test_the_take_keeps_rate_timecode_and_extras() -> None:
    source = Take(
        59.94, weights=Track(NAMES, random_weights(2)[..., None]), timecode=("a", "b"), extras={"subject": "me"}
    )
    editor = WeightEditor(NAMES, source.weights.values[..., 0])
    editor.set("jawOpen", 0.125)
    take = editor.to_take(source)
    assert (take.fps, take.timecode, take.extras) == (59.94, ("a", "b"), {"subject": "me"})
    assert take.weights.values[0, 0, 0] == 0.125
    assert torch.equal(take.weights.values[1], source.weights.values[1])


def test_bad_weights_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"expected \(T,4\)"):
        WeightEditor(NAMES, torch.zeros(3, 5))
    with pytest.raises(ValueRangeError, match="1 are NaN"):
        WeightEditor(NAMES, torch.tensor([[0.0, float("nan"), 0, 0]]))
    with pytest.raises(NameMismatchError, match="'frown'"):
        WeightEditor(NAMES).set("frown", 1.0)
    with pytest.raises(ValueRangeError, match="jawOpen"):
        WeightEditor(NAMES).set("jawOpen", float("inf"))

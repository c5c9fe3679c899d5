"""Models are of the class that checkers of types are told, and lie where they were asked for.

What such a checker makes of it stands in ``tests/types/zoo_models.py``, which `make lint` reads.
"""

from pathlib import Path
from typing import get_args, get_overloads, get_type_hints

import pytest
import torch

from torchface import zoo
from torchface.capture import MarkerSolver, ShapePrior
from torchface.errors import NameMismatchError, ValueRangeError
from torchface.modeling import MorphableModel

REPOSITORY = Path(__file__).resolve().parents[2]


def shipped() -> dict[str, type]:
    """The class that the overloads say, by name."""
    found = {}
    for overload in get_overloads(zoo.get_model):
        hints = get_type_hints(overload)
        for name in get_args(hints["name_or_path"]):
            if isinstance(name, str):
                found[name] = hints["return"]
    return found


def test_every_model_that_ships_is_of_the_class_that_its_overload_says() -> None:
    names = sorted(path.parent.name for path in (REPOSITORY / "models").glob("*/model.toml"))
    assert sorted(shipped()) == names
    assert {name: zoo.KINDS[zoo.describe(name).kind] for name in names} == shipped()


def test_a_model_of_another_class_is_refused_by_both_names(tmp_path: Path) -> None:
    card = zoo.ModelCard("MIT", "none", {"error": torch.tensor(0.5)}, "none")
    assert zoo.save_model(zoo.get_model("shape_prior"), tmp_path / "mine", card).metrics == {"error": 0.5}
    assert type(zoo.get_model(tmp_path / "mine", ShapePrior)) is ShapePrior
    assert type(zoo.get_model(tmp_path / "mine", torch.nn.Module)) is ShapePrior
    with pytest.raises(NameMismatchError, match=r"found .*mine, a ShapePrior, expected a MorphableModel"):
        zoo.get_model(tmp_path / "mine", MorphableModel)
    with pytest.raises(NameMismatchError, match="found head, a HeadModel, expected a MarkerSolver"):
        zoo.get_model("head", MarkerSolver)


def test_a_device_that_is_not_there_is_told_with_those_that_are() -> None:
    nowhere = f"cuda:{torch.cuda.device_count() + 3}"
    with pytest.raises(ValueRangeError, match=rf"device: found '{nowhere}' \(.+\), expected one of cpu"):
        zoo.get_model("shape_prior", device=nowhere)
    with pytest.raises(ValueRangeError, match="device: found 'toaster'"):
        zoo.get_model("shape_prior", device="toaster")


def test_a_model_lies_wholly_where_it_was_asked_for() -> None:
    for name in zoo.list_models():
        model = zoo.get_model(name, device=torch.device("meta"))
        assert {tensor.device.type for tensor in model.state_dict().values()} == {"meta"}, name


class Own(torch.nn.Module):
    config = None

    @classmethod
    def from_config(cls, config: dict[str, int]) -> "Own":
        return cls()


@pytest.mark.parametrize(
    ("kind", "model_class", "message"),
    [
        ("My Kind", Own, "found 'My Kind', expected up to 64 lower-case letters"),
        ("head", Own, "found 'head', which is HeadModel's, expected another name"),
        ("my_head", zoo.KINDS["head"], "found 'my_head' for HeadModel, which is 'head' already"),
        ("linear", torch.nn.Linear, "Linear: found no config, expected `config` and `from_config`"),
    ],
)
def test_kinds_that_cannot_be_registered(kind: str, model_class: type[torch.nn.Module], message: str) -> None:
    before = dict(zoo.KINDS)
    with pytest.raises(NameMismatchError, match=message):
        zoo.register(kind, model_class)
    assert before == zoo.KINDS

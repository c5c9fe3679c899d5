"""Parts that are exported by themselves: used twice and inside of a branch, the graph computes what the module does."""

import onnxruntime
import pytest
import torch
from torch import Tensor, nn

from torchface.onnx.exported_model import exported_model
from torchface.onnx.graph_parts import PART, graph_part, with_parts


class Doubled(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([2.0, 3.0, 5.0]))

    def forward(self, values: Tensor) -> Tensor:
        return values * self.weight + 1


def part(values: Tensor) -> Tensor:
    return graph_part([values], "doubled", [3])


class Around(nn.Module):
    def forward(self, values: Tensor) -> Tensor:
        again = torch.cond(values.sum() > 0, lambda x: part(x) - 1, lambda x: x.clone(), (values,))
        return part(again)


def test_a_part_is_put_in_wherever_it_is_used() -> None:
    around = exported_model(Around(), {"values": torch.zeros(3)}, ["out"], {}, None, PART)
    doubled = exported_model(Doubled(), {"values": torch.zeros(3)}, ["out"], {})
    whole = with_parts(around, {"doubled": doubled}, "weight")
    assert [one.name for one in whole.graph.initializer].count("weight") == 1
    session = onnxruntime.InferenceSession(whole.SerializeToString(), providers=["CPUExecutionProvider"])
    for values, expected in (([1.0, 1, 1], [5.0, 10, 26]), ([-1.0, -1, -1], [-1.0, -2, -4])):
        (found,) = session.run(None, {"values": torch.tensor(values).numpy()})
        assert found.tolist() == pytest.approx(expected)

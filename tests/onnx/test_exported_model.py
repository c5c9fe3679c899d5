"""Loops of a fixed number of short steps are written out; ONNX Runtime computes the same."""

import pytest
import torch
from torch import Tensor, nn

from torchface.landmarks.images.graph_session import graph_session
from torchface.onnx.exported_model import exported_model
from torchface.optim.fixed_splitting import fixed_loop


class Repeated(nn.Module):
    """Some sums and halves, three times."""

    def __init__(self, sums: int) -> None:
        super().__init__()
        self.sums = sums

    def forward(self, x: Tensor) -> Tensor:
        def step(y: Tensor) -> tuple[Tensor]:
            for _ in range(self.sums):
                y = 0.5 * y + x
            return (y,)

        return fixed_loop(step, 3, (x,))[0]


@pytest.mark.parametrize(("sums", "written_out"), [(1, True), (9, False)])
def test_short_steps_are_written_out(sums: int, written_out: bool) -> None:
    module, x = Repeated(sums), torch.linspace(-1, 1, 4)
    model = exported_model(module, {"x": x}, ["y"], {})
    assert ("Loop" not in {node.op_type for node in model.graph.node}) == written_out
    (found,) = graph_session(model.SerializeToString()).run(None, {"x": x.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), module(x))

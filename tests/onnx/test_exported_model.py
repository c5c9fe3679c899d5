"""Loops of a fixed number of short steps are written out, constants are small; ONNX Runtime computes the same."""

from __future__ import annotations

import pytest
import torch
from onnx import TensorProto
from torch import Tensor, nn

from torchface.onnx.checked_export import one_thread_session
from torchface.onnx.exported_model import byte_rows, exported_model, small_stored
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
    (found,) = one_thread_session(model.SerializeToString()).run(None, {"x": x.numpy()})
    torch.testing.assert_close(torch.from_numpy(found), module(x))


def test_even_rows_are_bytes_in_the_file_and_the_rest_halves() -> None:
    generator = torch.Generator().manual_seed(0)
    module = nn.Sequential(nn.Linear(64, 32), nn.Linear(32, 16))
    with torch.no_grad():
        levels = torch.randint(-127, 128, (32, 64), generator=generator).float()
        levels[:, 0] = 127
        module[0].weight.copy_(0.01 * torch.rand(32, 1, generator=generator) * levels)
        module[1].weight.normal_(generator=generator)
        for one in module:
            one.weight.copy_(one.weight.half().float())
    x = torch.randn(3, 64, generator=generator)
    model = small_stored(exported_model(module, {"x": x}, ["y"], {}), {"0.weight", "1.weight"})
    kinds = {one.name: one.data_type for one in model.graph.initializer}
    assert (kinds["0.weight byte"], kinds["1.weight half"]) == (TensorProto.INT8, TensorProto.FLOAT16)
    (found,) = one_thread_session(model.SerializeToString()).run(None, {"x": x.numpy()})
    expected = module(x).detach()
    torch.testing.assert_close(torch.from_numpy(found), expected, rtol=0, atol=2e-3 * float(expected.abs().max()))
    assert byte_rows(module[1].weight.detach().numpy()) is None

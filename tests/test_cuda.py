"""Models of the zoo on a GPU; tests/modules and tests/capture/own_rig/test_devices.py move all else."""

import pytest
import torch

from torchface import zoo

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that torch sees")


def test_models_lie_where_they_were_asked_for() -> None:
    for name in zoo.list_models():
        model = zoo.get_model(name, device="cuda")
        assert {tensor.device.type for tensor in model.state_dict().values()} == {"cuda"}, name


def test_a_detector_finds_what_it_finds_on_the_cpu() -> None:
    model = zoo.get_model("uv_landmarks")
    image = torch.rand(1, 3, model.size, model.size, generator=torch.Generator().manual_seed(0))
    wanted, found = model(image), model.to("cuda")(image.cuda())
    for here, there in zip(wanted, found, strict=True):
        assert there.is_cuda
        torch.testing.assert_close(there.cpu(), here, rtol=1e-3, atol=1e-3, equal_nan=True)

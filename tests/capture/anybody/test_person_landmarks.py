"""How people's landmarks differ, as a basis that is the same wherever it is computed."""

import pytest
import torch
from torch import Tensor

from torchface import zoo
from torchface.capture.anybody.person_landmarks import likeliest_differences


@pytest.fixture(scope="module")
def modes() -> Tensor:
    heads = zoo.get_model("head")
    return heads.shape.modes[:, heads.landmarks].double()


def test_coefficients_and_remainder_are_the_variance_of_every_landmark(modes: Tensor) -> None:
    basis, remainder = likeliest_differences(modes, 64)
    planted = modes.square().sum(0)
    planted[:17] += 4.0**2
    planted[17:27] += 2.5**2
    planted[27:] += 1.5**2
    explained = basis.square().sum(2)[:, :2].mean(1) + remainder
    torch.testing.assert_close(explained, planted[:, :2].mean(1), rtol=2e-3, atol=0)


@pytest.mark.parametrize("known", [True, False])
def test_another_build_of_lapack_gives_the_same_coefficients(
    modes: Tensor, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another sign of each vector, and another rounding of the matrix."""
    given = modes if known else None
    here, _ = likeliest_differences(given, 64)
    decompose, generator = torch.linalg.eigh, torch.Generator().manual_seed(0)

    def other(matrix: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.rand(matrix.shape, generator=generator, dtype=matrix.dtype) * 1e-15
        values, vectors = decompose(matrix * (1 + noise + noise.T))
        return values, vectors * (torch.rand(len(values), generator=generator) < 0.5).double().mul(2).sub(1)

    monkeypatch.setattr(torch.linalg, "eigh", other)
    there, _ = likeliest_differences(given, 64)
    torch.testing.assert_close(there, here, atol=1e-4, rtol=0)

"""The low-pass filter: half the amplitude at its wavelength, constants and loose parts kept, derivatives."""

import math

import pytest
import torch
from scipy import sparse
from scipy.sparse.linalg import spsolve

from torchface.enhancement.detail.low_pass import LowPass, vertex_areas
from torchface.errors import ShapeError, ValueRangeError


def _grid(columns: int, rows: int, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    vertices = torch.stack([x.flatten() * step, y.flatten() * step, torch.zeros(rows * columns)], dim=1)
    corner = (y[:-1, :-1] * columns + x[:-1, :-1]).flatten()
    faces = torch.cat(
        [
            torch.stack([corner, corner + 1, corner + columns + 1], 1),
            torch.stack([corner, corner + columns + 1, corner + columns], 1),
        ]
    )
    return vertices.double(), faces


def test_a_wave_of_its_wavelength_keeps_half_its_amplitude_and_longer_ones_more():
    vertices, faces = _grid(231, 4, 0.5)
    low_pass = LowPass(vertices, faces, 23.0)
    # Whole half-waves between the borders: cosines meet them without a slope, so that they are eigenfunctions.
    for wavelength, kept in ((230.0, 1 / 1.01), (46.0, 0.8), (23.0, 0.5), (11.5, 0.2)):
        wave = (2 * math.pi * vertices[:, 0] / wavelength).cos()[None, :, None]
        smooth = low_pass(wave)
        assert float((smooth * wave).sum() / wave.square().sum()) == pytest.approx(kept, rel=0.02)
        assert torch.allclose(smooth, kept * wave, atol=0.02)


def test_the_papers_equation_with_125_square_millimetres():
    vertices, faces = _grid(9, 8, 3.0)
    vertices[:, 2] = 4 * (vertices[:, 0] / 9).sin()
    count = len(vertices)
    weights, around = sparse.lil_array((count, count)), torch.zeros(count).double()
    for triangle in faces.tolist():
        p = vertices[triangle]
        area = float(torch.linalg.cross(p[1] - p[0], p[2] - p[0]).norm()) / 2
        for k in range(3):
            i, j, opposite = triangle[k], triangle[k - 2], k - 1
            u, v = p[k] - p[opposite], p[k - 2] - p[opposite]
            cotangent = float(u @ v) / float(torch.linalg.cross(u, v).norm())
            weights[i, j] += cotangent
            weights[j, i] += cotangent
            around[i] += area
    off = sparse.diags_array(1 / (4 * around.numpy())) @ weights.tocsr()
    K = off - sparse.diags_array(off.sum(axis=1))
    given = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).double()
    expected = spsolve((sparse.eye_array(count) - 125.0 * K).tocsc(), given.numpy())
    assert torch.allclose(LowPass(vertices, faces, 28.68)(given[None])[0], torch.from_numpy(expected), atol=1e-4)


def test_constants_and_the_mean_over_the_area_stay_and_loose_parts_do_not_mix():
    vertices, faces = _grid(6, 6, 2.0)
    other = vertices + torch.tensor([0.0, 0.0, 0.5])
    both = torch.cat([vertices, other, torch.tensor([[50.0, 0.0, 0.0]]).double()])
    low_pass = LowPass(both, torch.cat([faces, faces + 36]))
    given = torch.zeros(1, 73, 2).double()
    given[0, :36], given[0, 36:72, 0], given[0, 72] = 1.0, torch.rand(36).double(), 7.0
    smooth = low_pass(given)
    assert torch.allclose(smooth[0, :36], given[0, :36], atol=1e-9)
    assert torch.allclose(smooth[0, 72], given[0, 72], atol=1e-9)
    assert float(smooth[0, 36:72, 1].abs().max()) < 1e-12
    areas = vertex_areas(vertices, faces)
    mean, kept = ((areas @ values[0, 36:72, 0]) / areas.sum() for values in (given, smooth))
    assert float(kept) == pytest.approx(float(mean), rel=1e-9)
    assert float(smooth[0, 36:72, 0].std()) < 0.2 * float(given[0, 36:72, 0].std())
    assert low_pass(given.float()).dtype == torch.float32


def test_a_small_loose_part_comes_through_as_it_is():
    vertices, faces = _grid(9, 9, 2.0)
    small = vertices[torch.tensor([0, 1, 9])] + torch.tensor([0.0, 0.0, 5.0])
    low_pass = LowPass(torch.cat([vertices, small]), torch.cat([faces, torch.tensor([[81, 82, 83]])]))
    given = torch.randn(1, 84, 3).double()
    smooth = low_pass(given)
    assert torch.allclose(smooth[0, 81:], given[0, 81:], atol=1e-12)
    assert float((smooth - given)[0, :81].norm()) > 0.5 * float(given[0, :81].norm())


def test_derivatives_are_those_of_finite_differences():
    vertices, faces = _grid(4, 3, 5.0)
    low_pass = LowPass(vertices, faces)
    given = torch.randn(2, 12, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(low_pass, (given,), fast_mode=True)


def test_bad_input():
    vertices, faces = _grid(4, 3, 5.0)
    with pytest.raises(ShapeError, match=r"found \(2, 11, 3\), expected \(B,12,C\)"):
        LowPass(vertices, faces)(torch.zeros(2, 11, 3))
    with pytest.raises(ValueRangeError, match="wavelength: found 0"):
        LowPass(vertices, faces, 0.0)

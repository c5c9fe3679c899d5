"""Lens distortion agrees with OpenCV, goes back and forth, and says where nothing is seen."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from torchface.errors import ShapeError, ValueRangeError
from torchface.geometry.cameras.calibration import CameraCalibration, assumed_calibration
from torchface.geometry.cameras.distortion import distort, undistort

K = torch.tensor([[900.0, 0, 651.5], [0, 905, 349.25], [0, 0, 1]], dtype=torch.float64)
LENSES = {
    "barrel": [-0.28, 0.09, 0.0012, -0.0007, -0.01],
    "cushion": [0.12, -0.05, -0.002, 0.001, 0.02],
    "none": [0.0, 0.0, 0.0, 0.0, 0.0],
}


def lens(name: str) -> CameraCalibration:
    return CameraCalibration(K, torch.tensor(LENSES[name], dtype=torch.float64), 1280, 720, 0.1)


def grid() -> Tensor:
    """Pixels over the whole image and a little outside."""
    x, y = torch.meshgrid(torch.linspace(-20, 1300, 34), torch.linspace(-20, 740, 20), indexing="xy")
    return torch.stack([x, y], dim=-1).double()


@pytest.mark.parametrize("name", LENSES)
def test_as_opencv(name: str) -> None:
    cv2 = pytest.importorskip("cv2")
    camera, pixels = lens(name), grid()
    rays = torch.nn.functional.pad(pixels.reshape(-1, 2), (0, 1), value=1.0) @ torch.linalg.inv(K).T
    theirs, _ = cv2.projectPoints(rays.numpy(), (0, 0, 0), (0, 0, 0), K.numpy(), camera.distortion.numpy())
    torch.testing.assert_close(distort(pixels, camera).reshape(-1, 2), torch.from_numpy(theirs[:, 0]))
    criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 400, 1e-14)
    back = cv2.undistortPointsIter(
        pixels.reshape(-1, 1, 2).numpy(), K.numpy(), camera.distortion.numpy(), None, K.numpy(), criteria
    )
    torch.testing.assert_close(
        undistort(pixels, camera).reshape(-1, 2), torch.from_numpy(back[:, 0]), rtol=0, atol=1e-6
    )


@given(
    st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-0.005, 0.005), st.floats(-0.005, 0.005), st.integers(0, 9)
)
def test_there_and_back(k1: float, k2: float, p1: float, p2: float, seed: int) -> None:
    camera = CameraCalibration(K, torch.tensor([k1, k2, p1, p2, 0.0], dtype=torch.float64), 1280, 720)
    share = torch.rand(40, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    seen = share * torch.tensor([1280.0, 720.0])
    ideal = undistort(seen, camera)
    there = ideal.isfinite().all(-1)
    assert there.float().mean() > 0.7
    torch.testing.assert_close(distort(ideal, camera)[there], seen[there], rtol=0, atol=1e-7)


def test_nothing_is_seen_beyond_the_fold() -> None:
    # With k1 alone a lens shows no ray further out than 2/3 at r² = -1/(3 k1).
    camera = CameraCalibration(K, torch.tensor([-0.3, 0, 0, 0, 0], dtype=torch.float64), 1280, 720)
    furthest = 2 / 3 / math.sqrt(0.9)
    at = torch.tensor([[651.5 + 900 * share * furthest, 349.25] for share in (0.99, 1.01)], dtype=torch.float64)
    found = undistort(at, camera)
    assert found[0].isfinite().all()
    assert found[1].isnan().all()
    torch.testing.assert_close(distort(found[0], camera), at[0], rtol=0, atol=1e-7)


def test_shape_type_and_gaps_are_kept() -> None:
    pixels = grid().float()
    pixels[3, 4] = torch.nan
    for bend in (distort, undistort):
        found = bend(pixels, lens("barrel"))
        assert found.shape == pixels.shape
        assert found.dtype == torch.float32
        assert found[3, 4].isnan().all()
        assert int(found.isnan().sum()) == 2
    with pytest.raises(ShapeError, match=r"expected \(\.\.\.,2\)"):
        undistort(torch.zeros(3), lens("barrel"))


def test_gradients() -> None:
    camera = lens("barrel")
    pixels = grid()[::7, ::7].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda at: distort(at, camera), pixels, atol=1e-5)
    assert torch.autograd.gradcheck(lambda at: undistort(at, camera), pixels, atol=1e-5)


@given(st.sampled_from([(640, 360), (1920, 1080), (853, 480)]), st.sampled_from(sorted(LENSES)))
def test_another_resolution_sees_the_same(size: tuple[int, int], name: str) -> None:
    camera = lens(name)
    other = camera.resized(*size)
    share = torch.rand(20, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    places = [
        torch.nn.functional.pad(undistort(share * torch.tensor([one.width, one.height]) - 0.5, one), (0, 1), value=1.0)
        @ torch.linalg.inv(one.intrinsics).T
        for one in (camera, other)
    ]
    torch.testing.assert_close(*places)
    assert other.error == pytest.approx(0.1 * size[0] / 1280)
    with pytest.raises(
        ValueRangeError, match=r"1280 x 720 pixels, found images of 640 x 480, expected the same aspect"
    ):
        camera.resized(640, 480)


def test_an_assumed_camera_says_so() -> None:
    camera = assumed_calibration(480, 640, 90.0)
    assert camera.assumed
    assert not lens("none").assumed
    assert float(camera.intrinsics[0, 0]) == pytest.approx(320.0)
    assert camera.intrinsics[:2, 2].tolist() == [239.5, 319.5]
    assert assumed_calibration(640, 480).field_of_view == pytest.approx(60.0)
    assert camera.resized(960, 1280).assumed


def test_bad_calibrations() -> None:
    with pytest.raises(ShapeError, match="expected \\(3,3\\) and \\(5,\\)"):
        CameraCalibration(K, torch.zeros(4), 1280, 720)
    with pytest.raises(ValueRangeError, match="positive focal lengths"):
        CameraCalibration(-K, torch.zeros(5), 1280, 720)
    with pytest.raises(ValueRangeError, match="finite"):
        CameraCalibration(K * torch.nan, torch.zeros(5), 1280, 720)
    with pytest.raises(ValueRangeError, match="0 x 720"):
        CameraCalibration(K, torch.zeros(5), 0, 720)
    with pytest.raises(ValueRangeError, match="from 0"):
        CameraCalibration(K, torch.zeros(5), 1280, 720, float("nan"))
    with pytest.raises(ValueRangeError, match="angle between"):
        assumed_calibration(640, 480, 180.0)

"""A planted camera comes back; with noise the answer is OpenCV's, or better."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from torchface.errors import AlignmentError, ShapeError, ValueRangeError
from torchface.geometry.cameras.pnp import pixel_jacobian, solve_pnp
from torchface.synthetic import neutral_head

K = torch.tensor([[1400.0, 0, 639.5], [0, 1400, 511.5], [0, 0, 1]], dtype=torch.float64)


def face() -> torch.Tensor:
    mesh = neutral_head()
    return mesh.vertices[mesh.landmarks].double()


def planted(count: int, flat: bool = False) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points, rotations, translations, pixels of faces 400 to 1200 mm away, turned by up to 86°."""
    generator = torch.Generator().manual_seed(0)
    points = face()
    if flat:
        points = points * torch.tensor([1.0, 1, 0]).double()
    upright = torch.diag(torch.tensor([1.0, -1, -1]).double())
    angles = (torch.rand(count, 3, generator=generator).double() - 0.5) * torch.tensor([1.5, 3.0, 1.5]).double()
    rotation = upright @ torch.from_numpy(Rotation.from_euler("xyz", angles.numpy()).as_matrix())
    translation = torch.rand(count, 3, generator=generator).double() - 0.5
    translation = translation * torch.tensor([200.0, 200, 800]).double() + torch.tensor([0.0, 0, 800]).double()
    seen = points @ rotation.transpose(1, 2) + translation[:, None]
    pixels, _ = pixel_jacobian(seen, K)
    return points, rotation, translation, pixels


@pytest.mark.parametrize("flat", [False, True])
def test_a_planted_camera_is_found_from_nothing(flat: bool) -> None:
    points, rotation, translation, pixels = planted(60, flat)
    pixels[:, ::5] = torch.nan
    found = solve_pnp(points, pixels, K)
    torch.testing.assert_close(found.rotation, rotation, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.translation, translation, rtol=0, atol=1e-3)
    assert float(found.errors.max()) < 1e-5


def test_with_noise_as_good_as_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    points, _, _, pixels = planted(20)
    pixels = pixels + 2 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(1)).double()
    found = solve_pnp(points, pixels, K)
    for i in range(20):  # OpenCV takes one view at a time
        _, turn, move = cv2.solvePnP(points.numpy(), pixels[i].numpy(), K.numpy(), None, flags=cv2.SOLVEPNP_SQPNP)
        turn, move = cv2.solvePnPRefineLM(points.numpy(), pixels[i].numpy(), K.numpy(), None, turn, move)
        theirs, _ = cv2.projectPoints(points.numpy(), turn, move, K.numpy(), None)
        error = (torch.from_numpy(theirs[:, 0]) - pixels[i]).square().sum(-1).mean().sqrt()
        assert float(found.errors[i]) <= float(error) * (1 + 1e-6)
        torch.testing.assert_close(found.rotation[i], torch.from_numpy(cv2.Rodrigues(turn)[0]), rtol=0, atol=1e-3)


def test_weights_choose_whom_to_believe() -> None:
    points, rotation, _, pixels = planted(3)
    pixels[:, :17] += 30.0
    weights = torch.ones(68).double()
    weights[:17] = 0
    torch.testing.assert_close(solve_pnp(points, pixels, K, weights).rotation, rotation, rtol=0, atol=1e-6)
    assert float((solve_pnp(points, pixels, K).rotation - rotation).abs().max()) > 1e-3


def test_an_initial_guess_is_refined() -> None:
    points, _, translation, pixels = planted(3)
    found = solve_pnp(points, pixels + 1.0, K)
    again = solve_pnp(points, pixels, K, initial=found)
    torch.testing.assert_close(again.translation, translation, rtol=0, atol=1e-3)


def test_bad_input_is_named() -> None:
    points, _, _, pixels = planted(2)
    with pytest.raises(ShapeError, match=r"points \(67, 3\) and pixels \(2, 68, 2\)"):
        solve_pnp(points[1:], pixels, K)
    with pytest.raises(ShapeError, match=r"intrinsics: found \(3, 4\)"):
        solve_pnp(points, pixels, torch.zeros(3, 4))
    pixels[1, 3:] = torch.nan
    with pytest.raises(ValueRangeError, match="found 3 points seen in view 1, expected at least 4"):
        solve_pnp(points, pixels, K)
    line = torch.linspace(0, 100, 68)[:, None] * torch.ones(3)
    with pytest.raises(AlignmentError, match="lie on a line"):
        solve_pnp(line, torch.zeros(1, 68, 2), K)
    with pytest.raises(ValueRangeError, match="negative or infinite weight"):
        solve_pnp(points, pixels, K, -torch.ones(68))

"""Places of cameras beside another, from corners of a board that both see."""

import math

import pytest
import torch
from torch import Tensor

from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.distortion import distort
from torchface.geometry.rotations import rotation_matrix
from torchface.workflows.calibrate_beside import relative_place
from torchface.workflows.calibrate_camera import Board

K = torch.tensor([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]], dtype=torch.float64)
CAMERA = CameraCalibration(K, torch.tensor([-0.1, 0.02, 0.0, 0.0, 0.0]).double(), 1280, 720)


def seen(points: Tensor) -> Tensor:
    """Where a camera sees points (...,3) of its own frame."""
    return distort((points @ K.T)[..., :2] / points[..., 2:], CAMERA)


@pytest.mark.parametrize("board", [Board(9, 6, 25.0), Board(7, 7, 25.0)], ids=["oblong", "square"])
@pytest.mark.parametrize("roll", [0.0, 90.0, -90.0, 180.0, 30.0])
def test_a_camera_on_its_side_is_put_where_it_is(roll: float, board: Board) -> None:
    """Corners are found from whichever end looks first in each picture, which no other moment knows of."""
    generator = torch.Generator().manual_seed(0)
    turn = rotation_matrix(torch.tensor([[0.0, 0.0, math.radians(roll)]]).double())[0]
    turn = turn @ rotation_matrix(torch.tensor([[0.05, 0.4, 0.02]]).double())[0]
    stand = torch.tensor([-300.0, 20, 60]).double()
    turns = rotation_matrix(0.4 * torch.randn(10, 3, generator=generator).double())
    middles = torch.tensor([0.0, 0, 700]).double() + 40 * torch.randn(10, 3, generator=generator).double()
    points = (board.points.double() - board.points.double().mean(0)) @ turns.transpose(1, 2) + middles[:, None]
    noise = 0.1 * torch.randn(2, *points.shape[:2], 2, generator=generator)
    one = (seen(points) + noise[0]).float()
    other = (seen((points - stand) @ turn.T) + noise[1]).float()
    quarters = 1 if board.rows == board.columns else 2  # after a quarter turn an oblong board's rows remain its rows
    grids = other.reshape(10, board.rows, board.columns, 2)
    other = torch.stack([grid.rot90(quarters * i).flatten(0, 1) for i, grid in enumerate(grids)])
    R, t, error = relative_place(board, CAMERA, CAMERA, [*one], [*other])
    assert error < 0.3
    torch.testing.assert_close(R, turn, atol=2e-3, rtol=0)
    torch.testing.assert_close(-R.T @ t, stand, atol=1.5, rtol=0)

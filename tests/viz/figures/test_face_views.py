"""A view of a face shows the whole of a mesh that names no face."""

import pytest
import torch

from torchface.mesh import Mesh
from torchface.viz.figures.face_views import frame_face


@pytest.mark.parametrize("yaw", [0.0, 35.0, 90.0])
def test_the_whole_of_a_deep_mesh_is_in_the_picture(yaw: float) -> None:
    corners = torch.cartesian_prod(
        torch.tensor([-80.0, 80.0]), torch.tensor([-100.0, 100.0]), torch.tensor([0.0, 220.0])
    )
    mesh = Mesh(corners, torch.tensor([[0, 1, 2]]))
    pixels = frame_face(mesh, yaw).project(corners.double())
    assert bool((pixels > 0).all())
    assert bool((pixels < torch.tensor([400.0, 500.0])).all())

"""A scan's expression is read from the front, with and without colours, in any pose."""

from dataclasses import replace

import pytest
import torch

from torchface import BlendshapeRig, Mesh
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.registration import Registration
from torchface.registration.nonrigid.registration_record import RegistrationRecord
from torchface.synthetic import performer
from torchface.workflows.register.scan_expression import front_view, shown_expression


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=True)


def lying(mesh: Mesh) -> Registration:
    """A registration that met a scan exactly."""
    pose, count = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3)), len(mesh.vertices)
    record = RegistrationRecord("shape", 0.0, (), (), 0.0, 1.0, 0.0)
    bare = replace(mesh, texture=None, colors=None)
    return Registration(bare, pose, torch.zeros(count).double(), torch.ones(count, dtype=torch.bool), record)


SHAPES = [(), ("mouthSmileLeft", "mouthSmileRight"), ("jawOpen",), ("eyeBlinkLeft",)]


@pytest.mark.parametrize(  # each in one of the two ways everyday
    ("shapes", "colored"),
    [
        pytest.param(shapes, colored, marks=() if colored == (number % 2 == 1) else pytest.mark.bench)
        for number, shapes in enumerate(SHAPES)
        for colored in (True, False)
    ],
)
def test_what_a_scan_shows_is_named_and_eyes_do_not_count(
    rig: BlendshapeRig, shapes: tuple[str, ...], colored: bool
) -> None:
    weights = torch.tensor([float(name in shapes) for name in rig.names])
    scan = rig.neutral.with_vertices(rig(weights[None])[0].detach() @ rotation_matrix(torch.tensor([0.4, 2.0, -0.3])).T)
    scan = scan if colored else replace(scan, texture=None, colors=None)
    view = front_view(scan, lying(scan), rig.neutral)
    assert view is not None
    assert view.colored == colored
    named = {word.split("=")[0] for word in shown_expression(view).split()}
    expected = {name for name in shapes if not name.startswith("eye")}
    assert expected <= named
    assert bool(named) == bool(expected)
    assert not expected & {word.split("=")[0] for word in shown_expression(view, rig.names, weights).split()}


def test_a_template_without_landmarks_has_no_view(rig: BlendshapeRig) -> None:
    bare = replace(rig.neutral, annotations=None)
    assert front_view(rig.neutral, lying(bare), bare) is None

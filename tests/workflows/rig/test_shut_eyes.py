"""Shut eyes of a scan are recognised by its texture and by two fits; open ones are not taken for shut."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.mesh import Mesh
from torchface.registration import Registration
from torchface.registration.nonrigid.registration_record import RegistrationRecord
from torchface.rig import BlendshapeRig
from torchface.synthetic.head.performer import performer
from torchface.workflows.rig.shut_eyes import with_eye_note


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer(texture=True)


def weights(rig: BlendshapeRig, blink: float) -> Tensor:
    shown = torch.zeros(len(rig.names))
    shown[[rig.names.index("eyeBlinkLeft"), rig.names.index("eyeBlinkRight")]] = blink
    return shown


def exact(mesh: Mesh, distance: Tensor) -> Registration:
    """A registration that met the scan everywhere but at these distances (V,)."""
    pose = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
    record = RegistrationRecord("landmarks", 0.0, (), (), 0.0, 1.0, 0.0)
    return Registration(mesh, pose, distance.double(), torch.ones(len(distance), dtype=torch.bool), record)


def no_second_fit(weights: Tensor) -> Registration:
    raise AssertionError("the texture says enough")


@pytest.mark.parametrize(("blink", "taken", "note"), [
    (1.0, 0.0, "eyes are shut, as the eye network sees, .*--pose eyeBlinkLeft=1 eyeBlinkRight=1 gives"),
    (0.0, 1.0, "eyes are open, as the eye network sees, .* leave out --pose"),
    (1.0, 1.0, ""),
    (0.0, 0.0, ""),
    (0.4, 0.0, ""),
])  # fmt: skip
def test_a_scans_texture_shows_its_eyes(rig: BlendshapeRig, blink: float, taken: float, note: str) -> None:
    seen = rig.neutral.with_vertices(rig(weights(rig, blink)[None])[0].detach())
    turn = rotation_matrix(torch.tensor([0.4, 2.0, -0.3]))
    scan = seen.with_vertices(seen.vertices @ turn.T + 300)  # in any pose
    found = exact(replace(scan, texture=None, colors=None), torch.zeros(len(scan.vertices)))
    notes = with_eye_note(rig, scan, found, weights(rig, taken), no_second_fit).record.notes
    assert len(notes) == bool(note)
    if note:
        assert re.search(note, notes[0])


@pytest.mark.parametrize(("open_fit", "shut_fit", "shut"), [(0.27, 0.08, True), (0.1, 0.7, False), (0.1, 0.1, False)])
def test_without_colours_two_fits_say_which_lids_they_are(
    rig: BlendshapeRig, open_fit: float, shut_fit: float, shut: bool
) -> None:
    scan = replace(rig.neutral, texture=None, colors=None)
    asked: list[Tensor] = []

    def second(shown: Tensor) -> Registration:
        asked.append(shown)
        return exact(scan, torch.full((len(scan.vertices),), shut_fit))

    first = exact(scan, torch.full((len(scan.vertices),), open_fit))
    notes = with_eye_note(rig, scan, first, weights(rig, 0.0), second).record.notes
    assert torch.equal(asked[0], weights(rig, 1.0))
    assert [("eyes are shut, as the lids' shape says" in note) for note in notes] == [True] * shut

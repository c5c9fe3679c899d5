"""Shut eyes of a scan are recognised by its texture and by two fits; open ones are not taken for shut."""

import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from planted.characters import caricature
from torchface import BlendshapeRig, Mesh
from torchface.geometry.rotations import rotation_matrix
from torchface.geometry.similarity import Similarity
from torchface.registration import Registration
from torchface.registration.nonrigid.registration_record import RegistrationRecord
from torchface.synthetic import performer
from torchface.workflows.register.scan_expression import front_view
from torchface.workflows.rig.shut_eyes import eyes_shut_at_rest, with_eye_note, with_shut_eyes


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
    notes = with_eye_note(
        rig, front_view(scan, found, rig.neutral), found, weights(rig, taken), no_second_fit
    ).record.notes
    assert len(notes) == bool(note)
    if note:
        assert re.search(note, notes[0])


EYES = [
    (1.0, 0.0, (0.0, 0.0), "scan's left eye is shut, .* taken as open: --pose eyeBlinkLeft=1 gives"),
    (0.0, 0.0, (1.0, 0.0), "scan's left eye is open, .* taken as shut: leave out --pose eyeBlinkLeft=1$"),
    (1.0, 1.0, (1.0, 0.0), "scan's right eye is shut, .*: --pose eyeBlinkLeft=1 eyeBlinkRight=1 gives"),
    (1.0, 0.0, (0.0, 1.0), "left eye is shut, .* right eye is open, .*: --pose eyeBlinkLeft=1 gives"),
    (0.0, 1.0, (0.0, 1.0), ""),
]


@pytest.mark.parametrize(  # each in one of the two ways everyday
    ("left", "right", "taken", "note", "colored"),
    [
        pytest.param(*one, colored, marks=() if colored == (number % 2 == 0) else pytest.mark.bench)
        for number, one in enumerate(EYES)
        for colored in (True, False)
    ],
)
def test_each_eye_is_judged_for_itself(
    rig: BlendshapeRig, left: float, right: float, taken: tuple[float, float], note: str, colored: bool
) -> None:
    def pose(left: float, right: float) -> Tensor:
        shown = torch.zeros(len(rig.names))
        shown[[rig.names.index("eyeBlinkLeft"), rig.names.index("eyeBlinkRight")]] = torch.tensor([left, right])
        return shown

    def fitted(shown: Tensor) -> Registration:
        """Lids in another pose lie half as far off as they are apart."""
        apart = (rig(shown[None]) - rig(pose(left, right)[None]))[0].detach().norm(dim=-1)
        return exact(plain, 0.5 * apart + 0.1)

    scan = rig.neutral.with_vertices(rig(pose(left, right)[None])[0].detach())
    plain = replace(scan, texture=None, colors=None)
    found = fitted(pose(*taken)) if not colored else exact(plain, torch.zeros(len(scan.vertices)))
    second = no_second_fit if colored else fitted
    notes = with_eye_note(
        rig, front_view(scan if colored else plain, found, rig.neutral), found, pose(*taken), second
    ).record.notes
    assert len(notes) == bool(note)
    if note:
        assert re.search(note, notes[0])


@pytest.mark.parametrize("colored", [True, False])
def test_an_eye_that_the_scan_lacks_is_not_judged(rig: BlendshapeRig, colored: bool) -> None:
    plain = replace(rig.neutral, texture=None, colors=None)
    closer = exact(plain, torch.full((len(plain.vertices),), 0.1))
    found = exact(plain, torch.ones(len(plain.vertices)))
    found = replace(found, matched=plain.vertices[:, 0] > 0)  # the person's left half
    scan = rig.neutral if colored else plain  # with open eyes
    view = front_view(scan, found, rig.neutral)
    notes = with_eye_note(rig, view, found, weights(rig, 1.0), lambda shown: closer).record.notes
    assert re.search("scan's left eye is open, .*: --pose eyeBlinkRight=1 gives", notes[0])


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
    notes = with_eye_note(rig, front_view(scan, first, rig.neutral), first, weights(rig, 0.0), second).record.notes
    assert torch.equal(asked[0], weights(rig, 1.0))
    assert [("eyes are shut, as the lids' shape says" in note) for note in notes] == [True] * shut


def test_lashes_and_what_lies_behind_the_lids_do_not_say_whether_an_eye_is_shut(rig: BlendshapeRig) -> None:
    """With ICT-FaceKit's whole head 772 of 1,013 vertices that a blink moves were such: no eye counted as shown."""
    scan = replace(rig.neutral, texture=None, colors=None)
    behind = (rig.deltas.norm(dim=2).amax(0) > 2.0) & (torch.arange(len(scan.vertices)) % 5 > 0)
    face = rig.neutral.regions["face"] & ~behind
    head = replace(scan, annotations=replace(scan.annotations, regions={**scan.regions, "face": face}))
    template = BlendshapeRig(head, rig.deltas, rig.names)

    def fit(distance: float) -> Registration:
        found = exact(head, torch.where(behind, 4.0, distance))
        return replace(found, matched=face & (torch.arange(len(face)) % 4 == 0))

    found = fit(0.5)
    view = front_view(head, found, head)
    notes = with_eye_note(template, view, found, weights(rig, 0.0), lambda shown: fit(0.2)).record.notes
    assert "eyes are shut, as the lids' shape says" in notes[0]


def test_a_character_s_shut_eye_is_one_whose_lids_meet_before_an_eyeball() -> None:
    actor = performer(texture=False)
    for sides in ((True, True), (False, True), (False, False)):
        blinks = [f"eyeBlink{side}" for side, yes in zip(("Right", "Left"), sides, strict=True) if yes]
        posed = actor.neutral.with_vertices(actor.vertices + actor.deltas[actor.index(blinks)].sum(0))
        points = posed.vertices[actor.neutral.landmarks].double()
        one = torch.ones(1, dtype=torch.float64)
        pose = Similarity(one, torch.eye(3).double()[None], 0 * one[:, None].expand(1, 3))
        face = SimpleNamespace(head=posed, found=SimpleNamespace(points=points, pose=pose))
        assert eyes_shut_at_rest(face, actor.neutral) == sides


def test_a_caricature_s_shut_eyes_are_recognised_though_its_balls_are_large() -> None:
    actor = performer(texture=False)
    drawn = caricature(actor, actor.vertices[actor.neutral.landmarks], eyes=1.0)
    for blink in (0.0, 1.0):
        posed = drawn.neutral.with_vertices(drawn(weights(drawn, blink)[None])[0].detach())
        one = torch.ones(1, dtype=torch.float64)
        pose = Similarity(one, torch.eye(3).double()[None], 0 * one[:, None].expand(1, 3))
        found = SimpleNamespace(points=posed.vertices[actor.neutral.landmarks].double(), pose=pose)
        shut = eyes_shut_at_rest(SimpleNamespace(head=posed, found=found), actor.neutral)
        assert shut == (blink == 1.0, blink == 1.0)


def test_a_shut_eye_opens_as_wide_as_ever_and_its_lids_do_not_pass_each_other() -> None:
    actor = performer(texture=False)
    shut = with_shut_eyes(actor, (False, True))
    left, wide, right = (actor.index([name])[0] for name in ("eyeBlinkLeft", "eyeWideLeft", "eyeBlinkRight"))
    torch.testing.assert_close(shut.vertices, actor.vertices + actor.deltas[left])
    torch.testing.assert_close(shut.vertices + shut.deltas[wide], actor.vertices + actor.deltas[wide])
    assert not bool(shut.deltas[left].any())
    assert torch.equal(shut.deltas[right], actor.deltas[right])
    lids = actor.deltas[left].norm(dim=-1) > 4
    for name in ("eyeLookDownLeft", "eyeSquintLeft"):
        assert float(shut.deltas[actor.index([name])[0]][lids].norm(dim=-1).max()) == 0
    ball = actor.neutral.annotations.regions["eyeball_left"]
    down = actor.index(["eyeLookDownLeft"])[0]
    assert torch.equal(shut.deltas[down][ball], actor.deltas[down][ball])

"""A filmed performer: landmarks lie where the face shows them, expressions are those asked for."""

import math

import pytest
import torch

from planted.portrait_video import (
    EXPRESSIONS,
    PortraitSettings,
    PortraitVideo,
    expression_weights,
    mixed_expressions,
    render_portrait_video,
)
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer

SETTINGS = PortraitSettings(width=144, height=180)


@pytest.fixture(scope="module")
def rig() -> BlendshapeRig:
    return performer()


@pytest.fixture(scope="module")
def film(rig: BlendshapeRig) -> PortraitVideo:
    weights = expression_weights(rig.names, [EXPRESSIONS["jaw open"], EXPRESSIONS["eyes shut"]])
    return render_portrait_video(rig, weights, torch.Generator().manual_seed(2), SETTINGS)


def test_landmarks_lie_where_the_face_shows_them(film: PortraitVideo) -> None:
    def grey(frame: int, rows: list[int], above: int = 0) -> float:
        x, y = film.landmarks[frame, rows].mean(0).round().long().tolist()
        y -= above
        return float(film.frames[frame, y - 1 : y + 2, x - 1 : x + 2].float().mean())

    inside, tip, brow = grey(0, [62, 66]), grey(0, [30]), grey(0, [19], above=2)
    assert inside < 0.4 * tip  # an open mouth is dark
    assert brow < 0.8 * tip  # hair begins at its lower edge, where the landmark lies
    opening = [float((film.landmarks[i, 66] - film.landmarks[i, 62]).norm()) for i in (0, 1)]
    assert opening[0] > 5 * opening[1]
    shut = [float((film.landmarks[i, [37, 38]] - film.landmarks[i, [41, 40]]).norm()) for i in (0, 1)]
    assert shut[1] < 0.3 * shut[0]


def test_the_head_turns_and_the_film_comes_again(rig: BlendshapeRig, film: PortraitVideo) -> None:
    again = render_portrait_video(rig, film.weights, torch.Generator().manual_seed(2), SETTINGS)
    assert torch.equal(again.frames, film.frames)
    assert torch.equal(again.landmarks, film.landmarks)
    still = render_portrait_video(
        rig, film.weights[[0, 0]], torch.Generator().manual_seed(2), PortraitSettings(144, 180, 0, 0, noise=0)
    )
    assert torch.equal(still.landmarks[0], still.landmarks[1])
    assert torch.equal(still.frames[0], still.frames[1])
    eyes = film.landmarks[:, 45] - film.landmarks[:, 36]
    angles = torch.atan2(eyes[:, 1], eyes[:, 0])
    assert float((angles[0] - angles[1]).abs()) > math.radians(0.5)


def test_expressions_name_both_sides_and_mix_above_and_below(rig: BlendshapeRig) -> None:
    smile = expression_weights(rig.names, [{"mouthSmile": 0.7, "jawOpen": 0.2}])[0]
    named = {name: float(weight) for name, weight in zip(rig.names, smile, strict=True) if weight}
    assert named == pytest.approx({"mouthSmileLeft": 0.7, "mouthSmileRight": 0.7, "jawOpen": 0.2})
    poses = expression_weights(rig.names, list(EXPRESSIONS.values()))
    mixed = mixed_expressions(rig.names, 40, torch.Generator().manual_seed(0))
    above = torch.tensor([name.startswith(("brow", "eye", "cheekSquint", "noseSneer")) for name in rig.names])
    for part in (above, ~above):
        rows, known = mixed[:, part], poses[:, part]
        ratio = rows.amax(1, keepdim=True) / known.amax(1).clamp(min=1e-9)  # strength, were it this pose
        match = ((ratio[..., None] * known - rows[:, None]).abs().amax(2) < 1e-5) & (ratio <= 1 + 1e-6)
        assert (match & (ratio >= 0.75 - 1e-6) | (rows.amax(1, keepdim=True) == 0)).any(1).all()

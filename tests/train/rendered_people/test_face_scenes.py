"""Scenes have faces where they say, at the angle they say; the same number is the same picture."""

import numpy as np
import pytest
import torch

from torchface.errors import ValueRangeError
from train.rendered_people.face_scenes import ScenePeople, SceneSettings, cut_out, face_scene, upright_faces
from train.rendered_people.scene_clutter import clutter


class OneHead:
    def __init__(self, picture: torch.Tensor, landmarks: torch.Tensor) -> None:
        self.picture, self.landmarks, self.faces = picture, landmarks, upright_faces(landmarks)

    def __len__(self) -> int:
        return 1

    def person(self, number: int) -> np.ndarray:
        return cut_out(self.picture)


@pytest.fixture(scope="module")
def people() -> ScenePeople:
    """A head whose upper half is white and whose lower half is black, with landmarks where a face has them."""
    rows, columns = np.mgrid[:96, :96]
    picture = np.zeros((96, 96, 4), dtype=np.uint8)
    picture[..., :3] = np.where(rows < 48, 250, 5)[..., None]
    picture[..., 3] = np.where((rows - 48) ** 2 + (columns - 48) ** 2 < 40**2, 255, 0)
    turn = torch.linspace(0, np.pi, 17)
    jaw = torch.stack([48 - 30 * turn.cos(), 48 + 34 * turn.sin()], 1)
    brows = torch.tensor([[30 + 4 * k, 38] for k in range(5)] + [[50 + 4 * k, 38] for k in range(5)]).float()
    nose = torch.tensor([[48, 44 + 2 * k] for k in range(4)] + [[44 + 2 * k, 54] for k in range(5)]).float()
    eyes = torch.tensor([[32 + 2 * k, 44] for k in range(6)] + [[54 + 2 * k, 44] for k in range(6)]).float()
    mouth = torch.tensor([[40 + 16 * k / 19, 64] for k in range(20)]).float()
    return OneHead(torch.from_numpy(picture).permute(2, 0, 1), torch.cat([jaw, brows, nose, eyes, mouth])[None])


def test_faces_are_where_scenes_say_and_turned_as_they_say(people: ScenePeople) -> None:
    settings = SceneSettings(size=128, people=1, smallest=30, largest=60, turned=1.0, broken=0.0)
    right = count = 0
    for number in range(200):
        scene = face_scene(people, number, settings, seed=4)
        for (x, y, side, angle), uncertain in zip(scene.faces.tolist(), scene.uncertain.tolist(), strict=True):
            if uncertain:
                continue
            up = np.array([np.sin(angle), -np.cos(angle)]) * 0.3 * side
            ends = (np.array([x, y]) + sign * up for sign in (1, -1))
            above, below = (
                scene.image[:, round(v), round(u)].float().mean() for u, v in (e.clip(0, 127) for e in ends)
            )
            right, count = right + int(above > below + 4), count + 1
    assert count > 60
    assert right > 0.93 * count  # a hand or a bar may lie there


def test_a_number_is_a_picture(people: ScenePeople) -> None:
    settings = SceneSettings(size=64)
    first, again, other = (face_scene(people, 40, settings, seed) for seed in (1, 1, 2))
    assert torch.equal(first.image, again.image)
    assert torch.equal(first.faces, again.faces)
    assert not torch.equal(first.image, other.image)


def test_broken_faces_are_none(people: ScenePeople) -> None:
    settings = SceneSettings(size=96, broken=1.0, smallest=20, largest=60)
    assert sum(len(face_scene(people, 16 * number, settings).faces) for number in range(12)) == 0


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueRangeError, match="found size 10"):
        SceneSettings(size=10)
    with pytest.raises(ValueRangeError, match="0 x 5"):
        clutter(0, 5, np.random.default_rng(0))

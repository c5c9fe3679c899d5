"""Webcam videos of people that no network has seen, driven by the two test takes, rendered once and kept.

The takes' mouths hardly move (``jawOpen`` stays under 0.03), so for some seconds of each clip the mouth talks, smiles
and opens as a synthetic take's does; eyes, lids and brows are the real takes' own all the time.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

from planted.webcam_performance import (
    SittingSettings,
    WebcamPerformance,
    sitting,
    with_blinks,
    with_speech,
)
from planted.webcam_video import WebcamFrame, WebcamSettings, stacked, webcam_frames
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder, write_file
from torchface.io import load_take
from torchface.io.rigs.ict_facekit import load_ict_facekit, load_identity_modes
from torchface.io.video import open_video, write_video
from torchface.progress import Progress
from torchface.shape_names import ARKIT, mapping
from train.rendered_people.head_kind import HeadKind, people_kind, performer_kind
from train.rendered_people.looks import draw_looks
from train.rendered_people.people import Person

FPS = 30.0
CAMERA = WebcamSettings()
KEPT = Path("out/webcam_clips")
_METHOD = "webcam clips/2"


@dataclass(frozen=True)
class Scene:
    """One clip.

    Args:
        people: ``ict`` or ``performer``.
        seed: of the person, the room, the lamps, the head's motion.
        take: number of the test take, 0 or 1.
        start, length: seconds of it.
        sitting: where the person sits.
        speech: seconds between which the mouth talks.
        away, hand: seconds at which the person turns away, and at which a hand rises to the mouth.
        blinks: seconds at which full blinks begin besides the take's own.
    """

    people: str
    seed: int
    take: int
    start: float
    length: float
    sitting: SittingSettings
    speech: tuple[float, float]
    away: float | None = None
    hand: float | None = None
    blinks: tuple[float, ...] = ()


SHORT = {
    "ict, 4 s": Scene("ict", 92001, 1, 5.0, 4.0, SittingSettings(520, (10, 15), 5.0), (0.2, 3.9), hand=2.2),
    "performer, 4 s": Scene(
        "performer", 91005, 0, 17.5, 4.0, SittingSettings(560, (-30, 25), -4.0), (0.2, 3.9), away=1.2, blinks=(0.3, 3.3)
    ),
}
"""Of people and takes as in ``SCENES``: quick to render."""

SCENES = {
    "ict a": Scene("ict", 92001, 1, 5.0, 9.0, SittingSettings(520, (10, 15), 5.0), (1.0, 8.5), away=3.2, hand=6.3),
    "ict b": Scene("ict", 92005, 0, 7.0, 9.0, SittingSettings(430, (-15, 10), -11.0), (2.5, 8.0), hand=5.2),
    "performer a": Scene("performer", 91006, 1, 13.0, 9.0, SittingSettings(690, (40, -20), 3.0), (2.0, 7.5), hand=2.8),
    "performer b": Scene(
        "performer", 91005, 0, 17.5, 9.0, SittingSettings(560, (-30, 25), -4.0), (0.5, 6.0), away=6.2, blinks=(4.4,)
    ),
}


@dataclass(frozen=True, eq=False)
class Clip:
    """A video on disk and the truth about it.

    Args:
        path: of the video.
        person: who it shows.
        performance: what they do.
        truth: of each frame; ``picture`` is empty.
    """

    path: Path
    person: Person
    performance: WebcamPerformance
    truth: WebcamFrame

    def frames(self) -> Tensor:
        """What the webcam sends, uint8 (T,3,H,W)."""
        return torch.stack(list(open_video(self.path).color_frames()))


def webcam_clip(scene: Scene, data: Path, kept: Path = KEPT, progress: Progress | None = None) -> Clip:
    """Renders a scene, or reads what was rendered before.

    Args:
        scene: which.
        data: the folder of real data, with the takes, and ICT-FaceKit's heads for people of its kind.
        kept: folder of what was rendered.
        progress: called with each step and how far it is.
    """
    generator = torch.Generator().manual_seed(scene.seed)
    kind = _kind(scene.people, data)
    person = Person(kind, kind.draw(generator), draw_looks(generator))
    weights = _weights(scene, data)
    weights = with_blinks(with_speech(weights, FPS, generator, *scene.speech), FPS, scene.blinks)
    performance = sitting(weights, FPS, generator, scene.sitting, scene.away, scene.hand)
    key = content_key(_METHOD, scene=scene, camera=CAMERA, head=person.head.rest, performance=performance)[:16]
    make_folder(kept)
    video, notes = kept / f"{key}.mp4", kept / f"{key}.safetensors"
    if not notes.is_file():
        frames = list(webcam_frames(person, performance, scene.seed, CAMERA, progress))
        write_video((frame.picture[None] for frame in frames), video, FPS)
        truth = stacked([replace(frame, picture=frame.picture.new_zeros(0)) for frame in frames])
        write_file(notes, save({field.name: getattr(truth, field.name).contiguous() for field in fields(truth)}))
    return Clip(video, person, performance, WebcamFrame(**load_file(notes)))


def _weights(scene: Scene, data: Path) -> Tensor:
    """A take's weights at half its rate, (T,52)."""
    path = sorted((data / "performances").glob("*.csv"))[-2:][scene.take]
    take = load_take(path)
    assert take.weights is not None
    step = round(take.fps / FPS)
    rows = slice(round(scene.start * take.fps), round((scene.start + scene.length) * take.fps), step)
    return (take.weights.values[rows, :, 0] @ mapping(take.weights.names, ARKIT).T).float().clamp(0, 1)


@lru_cache(maxsize=2)
def _kind(people: str, data: Path) -> HeadKind:
    if people == "performer":
        return performer_kind()
    folder = data / "ict_facekit" / "FaceXModel"
    return people_kind(load_ict_facekit(folder), load_identity_modes(folder))

"""Webcam videos of people who act takes, rendered once and kept.

Where a take's mouth hardly moves, it talks, smiles and opens for some seconds as a synthetic take's does; eyes, lids
and brows are the take's own all the time.
"""

from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

from torchface.errors import ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.whole_files import make_folder, visible_files, write_file
from torchface.io import load_ict_facekit, load_identity_modes, load_take
from torchface.io.video import open_video, write_video
from torchface.progress import Progress
from torchface.shape_names import ARKIT, mapping

from ..people_performances import converse
from .head_kind import HeadKind, people_kind, performer_kind
from .looks import draw_looks
from .people import Person
from .webcam_performance import SittingSettings, WebcamPerformance, sitting, with_blinks, with_speech
from .webcam_video import WebcamFrame, WebcamSettings, stacked, webcam_frames

FPS = 30.0
"""Frames a second of every film."""

_METHOD = "webcam films/4"
_LOOKS = {
    "plain": {"glasses": None, "beard": 0.0, "moustache": 0.0, "stubble": 0.0},
    "glasses": {"glasses": (24.0, 17.0, 0.1, 2.0, 0.05), "beard": 0.0, "moustache": 0.0},
    "beard": {"glasses": None, "beard": 0.8, "moustache": 0.8, "stubble": 0.4},
    "both": {"glasses": (22.0, 16.0, 0.3, 2.4, 0.1), "beard": 0.6, "moustache": 0.7, "stubble": 0.4},
}


@dataclass(frozen=True)
class Scene:
    """What a film shows."""

    people: str  # `ict` or `performer`
    seed: int  # of the person, the backdrop, the lights, the head's motion
    take: int
    start: float  # seconds of it
    length: float  # seconds of it
    sitting: SittingSettings  # where the person sits
    speech: tuple[float, float] | None = None  # seconds between which the mouth talks; the take's own mouth if absent
    away: float | None = None  # seconds at which the person turns away, and at which a hand rises to the mouth
    hand: float | None = None  # seconds at which the person turns away, and at which a hand rises to the mouth
    blinks: tuple[float, ...] = ()  # seconds at which full blinks begin besides the take's own
    camera: WebcamSettings = field(default_factory=WebcamSettings)
    looks: str | None = None  # `plain`, `glasses`, `beard`, `both`, or as they are drawn if absent


@dataclass(frozen=True, eq=False)
class Film:
    """A video on disk and the truth about it."""

    path: Path
    person: Person  # who it shows
    performance: WebcamPerformance
    truth: WebcamFrame  # of each frame; picture is empty

    def frames(self) -> Tensor:
        """What the webcam sends, uint8 (T,3,H,W)."""
        return torch.stack(list(open_video(self.path).color_frames()))


@dataclass(frozen=True)
class FilmSources:
    """What films are made of.

    Args:
        takes: a folder of takes of weights; people of ``people_performances`` if absent.
        ict: ICT-FaceKit's FaceXModel folder, for people of its kind; embedded performers instead if absent.
    """

    takes: Path | None = None
    ict: Path | None = None


def webcam_film(scene: Scene, sources: FilmSources, kept: Path, progress: Progress | None = None) -> Film:
    """Renders a scene, or reads what was rendered before."""
    generator = torch.Generator().manual_seed(scene.seed)
    kind = performer_kind() if scene.people == "performer" or sources.ict is None else _people(sources.ict)
    head, looks = kind.draw(generator), draw_looks(generator)
    looks = looks if scene.looks is None else replace(looks, **_LOOKS[scene.looks])  # type: ignore[arg-type]
    person = Person(kind, head, looks)
    weights = _weights(scene, sources.takes)
    weights = weights if scene.speech is None else with_speech(weights, FPS, generator, *scene.speech)
    weights = with_blinks(weights, FPS, scene.blinks)
    performance = sitting(weights, FPS, generator, scene.sitting, scene.away, scene.hand)
    key = content_key(_METHOD, scene=scene, head=head.rest, performance=performance)[:16]
    make_folder(kept)
    video, notes = kept / f"{key}.mp4", kept / f"{key}.safetensors"
    if not notes.is_file():
        frames = list(webcam_frames(person, performance, scene.seed, scene.camera, progress))
        write_video((frame.picture[None] for frame in frames), video, FPS)
        truth = stacked([replace(frame, picture=frame.picture.new_zeros(0)) for frame in frames])
        write_file(notes, save({part.name: getattr(truth, part.name).contiguous() for part in fields(truth)}))
    return Film(video, person, performance, WebcamFrame(**load_file(notes)))


def _weights(scene: Scene, takes: Path | None) -> Tensor:
    """A take's weights at the film's rate, (T,52)."""
    if takes is None:
        count = round((scene.start + scene.length) * FPS)
        take = converse(count, torch.Generator().manual_seed(scene.take), FPS)
    else:
        paths = visible_files(takes, (".csv",))
        if scene.take >= len(paths):
            raise ValueRangeError(f"{takes}: found {len(paths)} takes (.csv), expected {scene.take + 1} at least")
        take = load_take(paths[scene.take])
    assert take.weights is not None
    step = round(take.fps / FPS)
    rows = slice(round(scene.start * take.fps), round((scene.start + scene.length) * take.fps), step)
    return (take.weights.values[rows, :, 0] @ mapping(take.weights.names, ARKIT).T).float().clamp(0, 1)


@lru_cache(maxsize=2)
def _people(folder: Path) -> HeadKind:
    return people_kind(load_ict_facekit(folder), load_identity_modes(folder))

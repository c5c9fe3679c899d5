"""Colour frames of someone before a webcam, as it takes them, with landmarks, irises and what hides them."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.geometry.cameras.pinhole import Camera
from torchface.progress import Progress, silent
from torchface.shape_names import ARKIT

from .head_kind import performer_kind
from .lashes import with_lashes
from .looks import draw_looks
from .people import Person, closed_lids
from .picture_geometry import annotated, surface
from .rendered_person import render_person, visible_points
from .scene_clutter import clutter, draw_hand
from .spectacles import with_glasses
from .turned_eyes import iris_centres, with_turned_eyes
from .webcam_performance import SittingSettings, WebcamPerformance, gaze_of, sitting

# Millimetres that a landmark may lie behind what is seen, on a curved edge, and still be visible; contour landmarks
# count where they are drawn.
_BEHIND = torch.tensor([45.0] * 17 + [7.0] * 51)
_SEEN = 20  # of the inner landmarks that must be visible for a face to be there
_MOVED = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "eyeBlinkLeft", "eyeBlinkRight")
_FINGERS_UP = 1.5 * np.pi  # radians, as pictures turn
_FAR = 1.1  # of a face's height that a hand which is not raised lies under the mouth


@dataclass(frozen=True)
class WebcamSettings:
    """The camera.

    Args:
        width, height: pixels.
        focal: focal length, pixels.
        blur: of the lens, standard deviation in pixels.
        noise: of the sensor, standard deviation, of 255.
        quality: of the JPEG pictures that webcams send, of 100.
    """

    width: int = 640
    height: int = 480
    focal: float = 560.0
    blur: float = 0.55
    noise: float = 3.0
    quality: int = 80

    @property
    def intrinsics(self) -> Tensor:
        """K, (3,3), pixels."""
        middle = ((self.width - 1) / 2, (self.height - 1) / 2)
        return torch.tensor([[self.focal, 0, middle[0]], [0, self.focal, middle[1]], [0, 0, 1]], dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class WebcamFrame:
    """One frame; the person's right eye comes first."""

    picture: Tensor  # uint8 (3,H,W), red first
    landmarks: Tensor  # iBUG's 68 as an annotator sees them, (68,2) pixels
    visible: Tensor  # which of them nothing hides and lie in the picture, (68,) bool
    iris: Tensor  # centres of the irises, (2,2) pixels
    present: Tensor  # whether there is a face to be seen, () bool


def stacked(frames: list[WebcamFrame]) -> WebcamFrame:
    """Frames as one, with a first dimension T in each field."""
    return WebcamFrame(
        *(torch.stack([getattr(frame, field.name) for frame in frames]) for field in fields(WebcamFrame))
    )


def webcam_frames(
    person: Person,
    performance: WebcamPerformance,
    seed: int,
    settings: WebcamSettings = WebcamSettings(),
    progress: Progress | None = None,
) -> Iterator[WebcamFrame]:
    """Renders frame by frame; lights, background, hair and hand stay what they are."""
    progress = progress or silent
    room = clutter(settings.height, settings.width, np.random.default_rng((seed, 0)))
    noise = np.random.default_rng((seed, 1))
    exposure: float | None = None  # the first frame's
    for number in range(len(performance)):  # each has a surface of its own
        posed = posed_head(person, performance.weights[number])
        camera = Camera(
            settings.intrinsics, performance.rotation[number], performance.translation[number],
            settings.width, settings.height,
        )  # fmt: skip
        frame, exposure = _seen(person, posed, camera, room, seed, exposure)
        picture = frame.picture.permute(1, 2, 0).contiguous().numpy()
        raised = float(performance.hand[number])
        covered = _with_hand(picture, frame.landmarks.numpy(), raised, seed) if raised > 0 else None
        visible = frame.visible if covered is None else frame.visible & ~_under(frame.landmarks, covered)
        stored = torch.from_numpy(_taken(picture, settings, noise)).permute(2, 0, 1).contiguous()
        yield WebcamFrame(stored, frame.landmarks, visible, frame.iris, frame.present)
        progress("rendering the video", number + 1, len(performance))


def posed_head(person: Person, weights: Tensor) -> Tensor:
    """The head (V,3) at ARKit's weights (52,), with eyes that look as they say."""
    posed = closed_lids(person.kind, person.head, weights)
    return with_turned_eyes(person.kind, person.head.rest, posed, gaze_of(weights))


def _seen(
    person: Person, posed: Tensor, camera: Camera, room: np.ndarray, seed: int, exposure: float | None
) -> tuple[WebcamFrame, float]:
    """Someone before a background, as light falls, before the camera takes it; uint8. And the exposure."""
    kind, looks = person.kind, person.looks
    pixels = camera.project(posed.double())
    landmarks = annotated(kind, pixels, looks).float()
    iris = camera.project(iris_centres(kind, posed).double()).float()
    marks = posed[kind.landmarks].double()
    scene = surface(kind, person.head, posed, looks, _drawn(seed, 2))
    part, left, top = _part(camera, scene.vertices)
    shift = torch.tensor([left, top])
    rendered = render_person(person, scene, part, _drawn(seed, 3), _drawn(seed, 4), exposure)
    tone = (0.3 * looks.hair).clamp(max=0.14)
    shown = looks.lashes or looks.liner > 0.3
    image = with_lashes(rendered.image, rendered.distance, part, marks, tone, shown, _drawn(seed, 5))
    visible = visible_points(rendered.distance, part, marks, landmarks - shift, _BEHIND)
    if looks.glasses is not None:
        image, hidden = with_glasses(image, part, marks, looks.glasses, _drawn(seed, 6))
        visible &= ~hidden
    inside = ((landmarks >= 0) & (landmarks <= torch.tensor([camera.width - 1, camera.height - 1]))).all(1)
    facing = bool((camera.rotation @ (camera.rotation.new_tensor([0.0, 0.0, 1.0])))[2] < -0.3)
    visible &= inside
    present = torch.tensor(facing and int(visible[17:].sum()) >= _SEEN)
    picture = room.copy()
    place = picture[top : top + part.height, left : left + part.width]
    cover = image[..., 3:].numpy()
    place[:] = (place * (1 - cover) + 255 * image[..., :3].clamp(0, 1).numpy() * cover).round()
    frame = WebcamFrame(torch.from_numpy(picture).permute(2, 0, 1), landmarks, visible, iris, present)
    return frame, rendered.exposure


def _part(camera: Camera, vertices: Tensor) -> tuple[Camera, int, int]:
    """A camera that sees no more of the picture than someone fills, and where its left upper corner lies."""
    pixels = camera.project(vertices.double())
    limit = torch.tensor([camera.width, camera.height])
    low = torch.minimum((pixels.amin(0) - 2).floor().long().clamp(min=0), limit - 16)
    high = torch.maximum(torch.minimum((pixels.amax(0) + 3).ceil().long(), limit), low + 16)
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2, 2] -= low
    (left, top), (width, height) = low.tolist(), (high - low).tolist()
    return Camera(intrinsics, camera.rotation, camera.translation, width, height), left, top


def _with_hand(picture: np.ndarray, landmarks: np.ndarray, raised: float, seed: int) -> np.ndarray:
    """Paints a hand before the mouth into a picture (H,W,3), and says where it is, (H,W) bool."""
    size = float(np.linalg.norm(landmarks[8] - landmarks[27]))
    middle = landmarks[48:60].mean(0) + np.array([0.05 * size, (0.15 + _FAR * (1 - raised)) * size])
    before = picture.copy()
    draw_hand(picture, middle, 0.85 * size, np.random.default_rng((seed, 7)), _FINGERS_UP - 0.35)
    return (before != picture).any(-1)


def _under(landmarks: Tensor, covered: np.ndarray) -> Tensor:
    """Which landmarks (68,2) lie where something covers the picture, (68,) bool."""
    height, width = covered.shape
    x, y = landmarks.round().long().unbind(1)
    return torch.from_numpy(covered)[y.clamp(0, height - 1), x.clamp(0, width - 1)]


def _taken(picture: np.ndarray, settings: WebcamSettings, noise: np.random.Generator) -> np.ndarray:
    """What a webcam sends: soft, noisy, compressed."""
    soft = cv2.GaussianBlur(picture, (0, 0), settings.blur).astype(np.float32)
    soft += settings.noise * noise.standard_normal(picture.shape, dtype=np.float32)
    stored = np.clip(soft, 0, 255).round().astype(np.uint8)
    coded = cv2.imencode(".jpg", stored[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, settings.quality])[1]
    sent = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    assert sent is not None
    return np.ascontiguousarray(sent[..., ::-1])


def _drawn(seed: int, number: int) -> torch.Generator:
    return torch.Generator().manual_seed(1_000_003 * seed + number)


def draw_subject(generator: torch.Generator) -> Person:
    """An embedded performer with hair, skin and clothes drawn at random, without glasses or hair over the eyes."""
    kind, looks = performer_kind(), draw_looks(generator)
    bare = replace(looks, glasses=None, hairdo=replace(looks.hairdo, curtain=0.0))
    return Person(kind, kind.draw(generator), bare)


def talking_subject(count: int) -> list[np.ndarray]:
    """Pictures of somebody who talks, smiles and blinks at 30 frames a second, uint8 (240,320,3) each."""
    generator = torch.Generator().manual_seed(7)
    person = draw_subject(generator)
    weights = torch.zeros(count, len(ARKIT))
    phase = torch.arange(count) / max(count - 1, 1) * torch.pi
    for row, name in enumerate(_MOVED):
        weights[:, ARKIT.index(name)] = 0.6 * torch.sin((1 + row // 2) * phase).clamp(min=0)
    acted = sitting(weights, 30.0, generator, SittingSettings(distance=450))
    frames = webcam_frames(person, acted, 7, WebcamSettings(320, 240, focal=300))
    return [frame.picture.permute(1, 2, 0).contiguous().numpy() for frame in frames]

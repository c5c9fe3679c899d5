"""A filmed face under another light, with another skin or another head, written as a film; what covers it stays."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from torchface.capture.own_rig.lighting import estimate_light
from torchface.errors import AlignmentError, ValueRangeError
from torchface.files.whole_files import check_ending, check_writable
from torchface.io.images.image_files import load_paint
from torchface.io.images.radiance_hdr import load_panorama
from torchface.io.video import open_video, write_video
from torchface.io.video.film_sound import sound_line
from torchface.io.video.video_writing import WRITTEN_ENDINGS
from torchface.landmarks.images.networks.part_finder import FaceParts
from torchface.mesh import Mesh
from torchface.progress import Progress, silent
from torchface.rendering.environment_light import EnvironmentLight
from torchface.rendering.point_light import PointLight, vertex_albedo
from torchface.rendering.texture_overlay import FacePaint, overlay, relight, skin_faces
from torchface.workflows.named_finders import part_finder
from torchface.workflows.relight.other_head import as_paint, other_head, placed
from torchface.workflows.relight.tracked_film import TrackedFilm, read_tracked_film
from torchface.workflows.relight.wanted_light import WantedLight

FilmLight = Literal["once", "each"]
Draw = Callable[[int, Tensor, PointLight | EnvironmentLight], Tensor]
_CHUNK = 8
_EVEN_SKIN = (0.80, 0.62, 0.53)
_LIT, _AGAIN = 5, 3  # frames from which the film's light is estimated, and those of a chunk
_BEFORE_SKIN = ("glasses", "hand", "cloth", "hair", "background")
_BEHIND = ("background",)  # the head of the track is wider than the filmed one here and there
_BEFORE_HEAD, _NAMED, _LEAST_HIDDEN = ("hand", "hair", "cloth"), ("hand", "glasses"), 0.005
_HIDDEN, _EDGE = 0.5, 0.3  # the share of what is before a face
_SPREAD, _SAME = 40.0, 4.0  # squared pixels of the network's crop, and a difference of colours of 255
_BACKLIT = 0.5  # of a panorama's mean; a face that gets less of it stays darker than in the film
_BESIDE = 110.0  # degrees of azimuth beyond which a light reaches no front of a face
_LEAST_SOURCE = 0.05  # share of the light below which its direction says nothing
_BEYOND = 60.0  # millimetres beyond the face, over neck, ears and scalp, in which the new light fades out
_INNER = ("eye", "lids", "brow", "nose", "upper_lip", "lower_lip")


_FROM_ABOVE = WantedLight(azimuth=20.0, elevation=40.0, strength=1.1, ambient=0.45)
_CHIN, _NECK = 8, (5.0, 45.0)  # its landmark, and millimetres below it over which another head fades into the neck
_BROWS, _SCALP = slice(17, 27), 10.0  # landmarks, and millimetres beyond the face above them over which its scalp fades


@dataclass(frozen=True)
class RelightSettings:
    """What the film is to show."""

    light: tuple[str, ...] = ()  # another light, as words; see `WantedLight`
    environment: Path | None = None  # a panorama of light (`.hdr`), of the film's mean brightness
    turn: float = 0.0  # of the panorama, degrees; its middle to the viewer's right
    exposure: float = 1.0  # how many times as bright as in the film the panorama makes the face
    texture: Path | None = None  # paint in the rig's texture coordinates
    rig: Path | None = None  # another head, which moves as the actor does
    film_light: FilmLight = "once"  # whether the film's light is estimated once, or every eight frames
    occluders: bool = True  # leave what is before the face as it is; without, only what lies behind it stays


def relight_film(
    film: Path, track: Path, out: Path, settings: RelightSettings, progress: Progress | None = None
) -> list[str]:
    """Reads a film and the folder that ``torchface track`` wrote of it, and writes the film anew; gives lines for
    people.

    Source: thesis 4.2.11 and figure 80.
    """
    progress = progress or silent
    check_ending(out, *WRITTEN_ENDINGS)
    open_video(film)
    wanted = {"--light": settings.light, "--environment": settings.environment, "--texture": settings.texture}
    wanted["--rig"] = settings.rig
    if not any(wanted.values()) or all((settings.light, settings.environment)) or all((settings.texture, settings.rig)):
        raise ValueRangeError(
            f"relight: found {', '.join(name for name, value in wanted.items() if value) or 'nothing to do'}, expected "
            "one of --light and --environment, one of --texture and --rig, or one of both"
        )
    check_writable(out)
    light = WantedLight.parse(settings.light) if settings.light else None
    panorama = None if settings.environment is None else load_panorama(settings.environment)
    progress("reading the track")
    tracked = read_tracked_film(film, track)
    draw = _painter(tracked, settings)
    lit = _spread(tracked.seen, _LIT)
    found = _light(tracked, dict(zip(lit, _frames(tracked, lit, progress), strict=True)))
    middle = tracked.middle
    whole, near = _reaching(found, middle), _near_face(tracked.rig.neutral)
    before: tuple[str, ...] = _BEFORE_HEAD if settings.rig is not None else _BEFORE_SKIN
    if not settings.occluders:
        before = () if settings.rig is not None else _BEHIND
    finder = part_finder() if before else None
    far = found.from_afar(middle)
    lines = [
        f"{tracked.video.count} frames, the face in {int(tracked.seen.sum())}; {_words(far, 'the film')}",
        *_doubts(far),
    ]
    hidden: list[float] = []

    def new_light(old: PointLight) -> PointLight | EnvironmentLight:
        if light is not None:
            return light.beside(old.from_afar(middle))
        if panorama is None:
            return old
        around = EnvironmentLight.of(panorama, settings.turn)
        reaching = max(float(around.on_front.mean()), _BACKLIT * float(around.mean.mean()), 1e-9)
        return around.scaled(settings.exposure * float(old.from_afar(middle).on_front().mean()) / reaching)

    def drawn() -> Iterator[Tensor]:
        latest, at = whole, 0
        changed = light is not None or panorama is not None
        for chunk in tracked.video.color_chunks(_CHUNK):
            earlier = latest
            if settings.film_light == "each":
                here = _spread(tracked.seen[at : at + len(chunk)], _AGAIN)
                pictures = {at + k: chunk[k] for k in here}
                latest = _reaching(_light(tracked, pictures, earlier), middle) if here else earlier
            for k, frame in enumerate(chunk):
                if bool(tracked.seen[at]):
                    old = _between(earlier, latest, (k + 1) / len(chunk))
                    new = new_light(old)
                    result = frame
                    if changed:
                        posed = tracked.rig.neutral.with_vertices(tracked.vertices(at))
                        lens = tracked.calibration
                        result = relight(frame, posed, old, new, tracked.camera(at), lens, near, finder is not None)
                    if draw is not None:
                        result = draw(at, result, new)
                    if finder is not None:
                        parts = finder(frame, tracked.landmarks[at])
                        mask = _shown(frame, parts, before, tracked.landmarks[at])
                        if settings.occluders:
                            hidden.append(float((parts.of(*_NAMED) > 0.5).float().mean()))
                        result = torch.lerp(frame.float(), result.float(), mask).round().to(torch.uint8)
                    yield result[None]
                else:
                    yield frame[None]
                at += 1
                progress("relighting", at, tracked.video.count)

    write_video(drawn(), out, tracked.video.fps, tracked.video.uneven_seconds()[0], film)
    lines += sound_line(film, out)
    if max(hidden, default=0.0) > _LEAST_HIDDEN:
        lines.append(
            f"hands or glasses cover {max(hidden):.0%} of the picture of the face at most; they stay as they are"
        )
    return lines


def _painter(tracked: TrackedFilm, settings: RelightSettings) -> Draw | None:
    """Draws paint or another head on a frame; None where neither is asked for."""
    moved: Callable[[int], Tensor] = tracked.vertices
    share: Tensor | None = None
    if settings.texture is not None:
        paint = FacePaint.of(tracked.rig.neutral, load_paint(settings.texture))
    elif settings.rig is not None:
        other = other_head(settings.rig)
        paint, moved = as_paint(other.neutral), placed(other, tracked, settings.rig)
        height = other.vertices[:, 1] - other.vertices[other.neutral.landmarks[_CHIN], 1]
        share = ((height + _NECK[1]) / (_NECK[1] - _NECK[0])).clamp(0, 1)
        # The film's own hair, or scalp, is kept.
        brows = other.vertices[other.neutral.landmarks[_BROWS], 1].mean()
        share = torch.where(other.vertices[:, 1] > brows, share * _near_face(other.neutral, _SCALP), share)
    else:
        return None

    def draw(frame: int, image: Tensor, light: PointLight | EnvironmentLight) -> Tensor:
        if settings.rig is not None and isinstance(light, PointLight) and not bool(light.intensity.any()):
            light = _FROM_ABOVE.beside(light)  # a head in light without a direction would look flat
        return overlay(image, moved(frame), paint, light, tracked.camera(frame), tracked.calibration, share)

    return draw


def _shown(frame: Tensor, parts: FaceParts, before: Sequence[str], marks: Tensor) -> Tensor:
    """How far each pixel of a frame (3,H,W) shows what some parts do not hide, (H,W) in [0,1].

    Hair within the hull of the landmarks (68,2) is a beard or brows, which belong to the face.
    """
    y, x = torch.meshgrid(torch.arange(frame.shape[1]), torch.arange(frame.shape[2]), indexing="ij")
    pixels = torch.stack([x, y], -1)
    hidden = parts.around(pixels, *before)
    if "hair" in before:
        hull = cv2.convexHull(marks[torch.isfinite(marks).all(1)].float().numpy()).round().astype(np.int32)
        inside = torch.from_numpy(cv2.fillConvexPoly(np.zeros(frame.shape[1:], np.uint8), hull, 1)).bool()
        others = parts.around(pixels, *(name for name in before if name != "hair"))
        hidden = torch.where(inside, others, hidden)
    # The network's crop is coarser than the frame: what it found follows the edges of the frame.
    guide = frame.permute(1, 2, 0).contiguous().numpy()
    spread = _SPREAD / float(parts.transform[:, :2].det().abs())
    smooth = cv2.ximgproc.fastGlobalSmootherFilter(guide, hidden.float().numpy(), spread, _SAME)
    return ((_HIDDEN - torch.from_numpy(smooth)) / _EDGE + 0.5).clamp(0, 1)


def _light(tracked: TrackedFilm, frames: dict[int, Tensor], fallback: PointLight | None = None) -> PointLight:
    """The light of some frames, beside the rig's colours or skin of one colour; the fallback where they show too little
    of the face."""
    neutral = tracked.rig.neutral
    try:
        albedo = vertex_albedo(neutral)
    except ValueRangeError:
        albedo = torch.tensor(_EVEN_SKIN).expand(len(neutral.vertices), 3)
    skin = torch.zeros(len(neutral.vertices))
    skin[neutral.faces[skin_faces(neutral)].flatten()] = 1.0
    vertices = torch.stack([tracked.vertices(t) for t in frames])
    cameras, pictures = [tracked.camera(t) for t in frames], torch.stack(list(frames.values()))
    try:
        return estimate_light(pictures, vertices, neutral.faces, albedo, cameras, skin, tracked.calibration).light
    except AlignmentError:
        if fallback is None:
            raise
        return fallback


def _frames(tracked: TrackedFilm, wanted: Sequence[int], progress: Progress) -> list[Tensor]:
    frames, at = [], 0
    for chunk in tracked.video.color_chunks(_CHUNK):
        frames += [chunk[t - at].clone() for t in wanted if at <= t < at + len(chunk)]
        at += len(chunk)
        progress("looking for the light", at, tracked.video.count)
        if len(frames) == len(wanted):
            break
    return frames


def _spread(seen: Tensor, count: int) -> list[int]:
    rows = seen.nonzero()[:, 0]
    return rows[torch.linspace(0, len(rows) - 1, min(count, len(rows))).round().long().unique()].tolist()


def _doubts(light: PointLight) -> list[str]:
    """A warning where the film's light is not one that a face looking at the camera would show."""
    around, _, ambient = _angles(light)
    if abs(around) <= _BESIDE or 1 - ambient < _LEAST_SOURCE:
        return []
    return [
        f"warning: the film's light is estimated from behind the head (azimuth={around:.0f}, {1 - ambient:.0%} of all "
        "light), where it reaches no skin that the film shows; the film's light is taken to be even"
    ]


def _reaching(light: PointLight, middle: Tensor) -> PointLight:
    """The light without a source behind a head at ``middle`` (3,), of which a face gets nothing."""
    return replace(light, intensity=torch.zeros_like(light.intensity)) if _doubts(light.from_afar(middle)) else light


def _near_face(mesh: Mesh, beyond: float = _BEYOND) -> Tensor:
    """1 on the face, eyes and mouth, less with the distance from it, (V,); 1 everywhere on a head without regions."""
    regions = mesh.regions
    if "face" not in regions:
        return torch.ones(len(mesh.vertices))
    face = regions["face"].cpu() | _inner(mesh)
    exact = "donot_use_mm_for_euclid_dist"
    distance = torch.cdist(mesh.vertices, mesh.vertices[face], compute_mode=exact).amin(1)
    return (1 - distance / beyond).clamp(0, 1)


def _inner(mesh: Mesh) -> Tensor:
    """Eyes, nose and mouth, (V,) bool."""
    inner = torch.zeros(len(mesh.vertices), dtype=torch.bool)
    inner[mesh.faces[~skin_faces(mesh)].flatten()] = True
    for name, mask in mesh.regions.items():
        if name.startswith(_INNER):
            inner |= mask.cpu()
    return inner


def _between(before: PointLight, after: PointLight, share: float) -> PointLight:
    return PointLight(*(torch.lerp(a, b, share) for a, b in zip(astuple(before), astuple(after), strict=True)))


def _words(light: PointLight, what: str) -> str:
    around, up, share = _angles(light)
    return f"the light of {what}: azimuth={around:.0f} elevation={up:.0f} ambient={share:.2f}"


def _angles(light: PointLight) -> tuple[float, float, float]:
    """Azimuth and elevation, degrees, and the share from everywhere."""
    x, y, z = torch.nn.functional.normalize(light.position, dim=0).tolist()
    around, up = math.degrees(math.atan2(x, -z)), math.degrees(math.asin(max(-1.0, min(1.0, -y))))
    return around, up, float(light.ambient.mean() / (light.ambient + light.intensity).mean().clamp(min=1e-9))

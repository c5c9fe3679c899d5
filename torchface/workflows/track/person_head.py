"""The head of whoever a video shows: solved with a head model from frames of several angles and expressions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.capture.weight_readings import LASTING
from torchface.errors import ValueRangeError
from torchface.geometry.cameras.distortion import undistort, undistort_image
from torchface.geometry.meshes.normal_maps import SurfaceMaps
from torchface.io.video.blank_video import BlankVideo
from torchface.landmarks.images.face_reading import FaceReading
from torchface.modeling import FitSettings, HeadModel, ImageFit, fit_images, transfer_with_report
from torchface.modeling.photographs.frame_choice import choose_frames
from torchface.modeling.photographs.landmark_view import JAW
from torchface.progress import Progress
from torchface.rig import BlendshapeRig
from torchface.workflows.fit.fit_readings import with_readings
from torchface.workflows.named_finders import part_finder
from torchface.workflows.track.track_inputs import TrackInputs

FRAMES = 10
"""How many frames the head is solved from at most."""

_DOUBTED = 0.2  # trust below which a landmark does not count


@dataclass(frozen=True, eq=False)
class PersonHead:
    """The person's rig, and the frames that it comes from."""

    rig: BlendshapeRig  # the head found, with the shapes of the model's rig transferred to it
    fit: ImageFit
    frames: Tensor  # their numbers, (F,)
    # it with skin, hair and teeth, where pictures show them; the shapes are the rig's
    shown: BlendshapeRig | None = None
    surface: SurfaceMaps | None = None  # how that shades

    def lines(self) -> list[str]:
        """For people to read."""
        eyes = (self.fit.landmarks[:, 36] - self.fit.landmarks[:, 45]).norm(dim=-1)
        inner = (self.fit.residuals[:, JAW:].square().sum(-1).nanmean(-1).sqrt() / eyes).mean()
        found = self.fit.agreement
        skin = "" if found is None else f"; moved to where {found.matches} places of skin lie in several frames"
        listed = ", ".join(str(frame) for frame in self.frames.tolist())
        return [
            f"head: solved from {len(self.frames)} frames ({listed}); inner landmarks {float(inner):.1%} of the eyes' "
            f"distance off in them; at most {float(self.fit.coefficients.abs().max()):.2f} standard deviations from "
            f"the mean head in a mode; 3 are rare{skin}"
        ]


@dataclass(frozen=True, eq=False)
class HeadFrames:
    """Frames that a head is solved from."""

    numbers: Tensor  # (F,)
    pictures: Sequence[Tensor] = ()  # uint8 (3,H,W), without distortion; none where there is no video

    @staticmethod
    def of(inputs: TrackInputs, landmarks: Tensor, reading: FaceReading) -> "HeadFrames":
        """Those of a take that differ most, by its landmarks (T,68,2)."""
        rig, clip = inputs.actor, inputs.clip
        rest = rig.vertices[rig.neutral.landmarks].detach()
        try:
            numbers = choose_frames(rest, landmarks, reading.trust, FRAMES)
        except ValueRangeError as error:
            raise ValueRangeError(f"{clip.path}: {error}") from error
        if isinstance(clip, BlankVideo):
            return HeadFrames(numbers)
        wanted, pictures = set(numbers.tolist()), list[Tensor]()
        for number, frame in enumerate(clip.color_frames()):
            if number in wanted:
                pictures.append(undistort_image(frame, inputs.calibration))
            if len(pictures) == len(wanted):
                break
        return HeadFrames(numbers, pictures)


def person_head(
    inputs: TrackInputs,
    heads: HeadModel,
    shown: HeadFrames,
    landmarks: Tensor,
    reading: FaceReading,
    progress: Progress,
) -> PersonHead:
    """Solves the head of a take, its expressions and poses together, from smoothed landmarks (T,68,2) and the skin that
    its frames show; see ``fit_images``.

    The inputs' actor is the rig of the model's mean head; the reading says how far each landmark is trusted.
    """
    progress("solving the head")
    rig, clip, trust, frames = inputs.actor, inputs.clip, reading.trust, shown.numbers
    marks = torch.where((trust > _DOUBTED)[..., None], landmarks, torch.nan)[frames]
    few = (torch.isfinite(marks[:, JAW:]).all(-1).sum(1) < FRAMES)[:, None, None]
    found = inputs.models.finder is not None
    parts = [part_finder()(*one) for one in zip(shown.pictures, landmarks[frames].double(), strict=False)]
    settings = FitSettings(
        expression_prior=inputs.models.prior, annotated=found, texture_size=0, parts=parts if shown.pictures else None
    )
    if found:
        read = replace(
            reading.of_frames(frames),
            iris=undistort(reading.iris[frames].double(), inputs.calibration),
            points=undistort(reading.points[frames].double(), inputs.calibration),
            expression_deviation=reading.expression_deviation[frames] / math.sqrt(LASTING),
        )
        settings = with_readings(settings, read, inputs.models.places, rig)
    fit = fit_images(
        heads,
        rig,
        torch.where(few, landmarks[frames], marks),
        (clip.width, clip.height),
        [picture.float() / 255 for picture in shown.pictures] or None,
        camera=inputs.calibration.intrinsics,
        settings=settings,
        progress=progress,
    )
    return PersonHead(transfer_with_report(rig, fit.mesh, progress=progress).rig, fit, frames)

"""The skin of a head that was solved with a take, from sharp frames in which the face acts little."""

from dataclasses import replace

import torch
from torch import Tensor

from torchface.landmarks.images.face_reading import FaceReading
from torchface.modeling import FitSettings, HeadModel
from torchface.modeling.photographs.image_fit import with_skin
from torchface.progress import Progress
from torchface.synthetic.head.embedded_character import is_performers
from torchface.workflows.fit.fitted_character import dressed_rig
from torchface.workflows.fit.video_pictures import sharpness_of
from torchface.workflows.named_finders import part_finder
from torchface.workflows.track.face_overlay import undistorted
from torchface.workflows.track.person_head import PersonHead
from torchface.workflows.track.track_inputs import TrackInputs

_SIDES = 15.0  # degrees from which a head shows another side
_SHARP = 0.6  # of the sharpest frame


def with_filmed_skin(
    head: PersonHead, inputs: TrackInputs, model: HeadModel, reading: FaceReading, progress: Progress
) -> PersonHead:
    """A head as it is shown: with skin of sharp frames from the front and from each side, and what belongs to it.

    Args:
        head: solved from frames of the take.
        inputs: with the video.
        model: that the head is of.
        reading: of the frames, (T,...).
    """
    progress("finding the head's skin")
    wanted = dict.fromkeys(head.frames.tolist())
    for number, frame in enumerate(inputs.clip.color_frames()):
        if number in wanted:
            wanted[number] = undistorted(frame, inputs.calibration)
        if number >= max(wanted):
            break
    rows = _chosen(head, [frame for frame in wanted.values() if frame is not None], reading)
    frames = head.frames[rows]
    pictures = [wanted[number] for number in frames.tolist()]
    images = [picture.float() / 255 for picture in pictures if picture is not None]
    marks = head.fit.landmarks[rows].double()
    parts = [part_finder()(picture, one) for picture, one in zip(pictures, marks, strict=True) if picture is not None]
    whole = is_performers(head.rig)
    settings = FitSettings(parts=parts, paint_hair=not whole, irises=reading.iris[frames])
    views = replace(
        head.fit,
        posed=tuple(head.fit.posed[row] for row in rows),
        cameras=tuple(head.fit.cameras[row] for row in rows),
        landmarks=head.fit.landmarks[rows],
        residuals=head.fit.residuals[rows],
    )
    fit = with_skin(views, model, images, settings)
    assert inputs.actor is not None
    dressed = dressed_rig(head.rig, inputs.actor, fit, images, parts, marks, whole)
    return replace(head, shown=dressed.rig.select(head.rig.names), surface=dressed.surface)


def _chosen(head: PersonHead, pictures: list[Tensor], reading: FaceReading) -> list[int]:
    """Which of the head's frames show the skin: from the front, from the left and from the right, of the sharp ones
    that in which the face acts least, for a smile paints its folds and the light on its cheeks."""
    ahead = torch.stack([camera.rotation[2] for camera in head.fit.cameras])
    yaw = torch.rad2deg(torch.atan2(-ahead[:, 0], -ahead[:, 2]))
    sharp = torch.stack([
        sharpness_of(picture, reading.box[number])
        for picture, number in zip(pictures, head.frames.tolist(), strict=True)
    ])  # fmt: skip
    acts = head.fit.weights.sum(1)
    sides = (yaw.abs() <= _SIDES, yaw > _SIDES, yaw < -_SIDES)
    chosen = [side & (sharp >= _SHARP * sharp[side].amax()) for side in sides if bool(side.any())]
    return [int(torch.where(some, acts, torch.inf).argmin()) for some in chosen]

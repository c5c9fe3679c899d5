"""A film with what ``torchface track`` found in it: the rig, its weights and the head's pose in every frame."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.files.documents import read_json
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.geometry.cameras.pinhole import Camera
from torchface.io import load_animation, load_rig
from torchface.io.landmarks.openface_csv import load_landmarks_csv
from torchface.io.video import VideoFile, open_video
from torchface.io.weights.weight_csv import ROTATIONS
from torchface.part_materials import part_material
from torchface.rig import BlendshapeRig
from torchface.workflows.head_rotations import head_rotations
from torchface.workflows.track.track_files import ANIMATION, LANDMARKS, SUMMARY, SUMMARY_FORMAT
from torchface.workflows.track.upright_rig import upright

_GROWN = ("hair", "lash_hair", "brow_hair", "shirt")
_POSE = (*(f"pose_T{axis}" for axis in "xyz"), *(f"pose_{name.removeprefix('Head').lower()}" for name in ROTATIONS[:3]))


@dataclass(frozen=True, eq=False)
class TrackedFilm:
    """A film and the face in it."""

    video: VideoFile
    rig: BlendshapeRig
    weights: Tensor  # of its shapes, (T,N)
    # rotation, translation: from the rig to the camera, (T,3,3) and (T,3) millimetres
    rotation: Tensor
    translation: Tensor
    landmarks: Tensor  # iBUG's 68 as they were found, (T,68,2) pixels
    seen: Tensor  # frames that show the face, (T,) bool
    calibration: CameraCalibration

    def camera(self, frame: int) -> Camera:
        """The camera of a frame, from the rig's space, without distortion."""
        pose = self.rotation[frame], self.translation[frame]
        return Camera(self.calibration.intrinsics.double(), *pose, self.video.width, self.video.height)

    @property
    def middle(self) -> Tensor:
        """Of the head in the camera's frame, in the mean of the film, (3,) millimetres."""
        points = self.rotation[self.seen] @ self.rig.vertices.double().mean(0) + self.translation[self.seen]
        return points.mean(0)

    def vertices(self, frame: int) -> Tensor:
        """The face of a frame in the rig's space, (V,3)."""
        return self.rig(self.weights[frame : frame + 1].to(self.rig.deltas))[0]


def read_tracked_film(film: Path, track: Path) -> TrackedFilm:
    """Reads a film and the folder that ``torchface track`` wrote of it."""
    for name in (SUMMARY, LANDMARKS, ANIMATION):
        if not (track / name).is_file():
            raise FileFormatError(f"{track}: found no {name}, expected the folder that `torchface track` wrote")
    video, record = replace(open_video(film), even=False), read_json(track / SUMMARY, SUMMARY_FORMAT)
    marks, animation = load_landmarks_csv(track / LANDMARKS), load_animation(track / ANIMATION)
    if animation is None or animation.weights is None or marks.landmarks is None:
        raise FileFormatError(f"{track / ANIMATION}: found no weights over time, expected those of `torchface track`")
    count = len(marks.landmarks)
    if video.count != count:
        raise ValueRangeError(
            f"{film}: found {video.count} frames, expected the {count} of {track}: it is another film, or was cut"
        )
    if len(animation.weights) != count:
        raise ValueRangeError(
            f"{track / ANIMATION}: found {len(animation.weights)} keys for {count} frames, expected one each; track "
            "without --reduce"
        )
    columns = marks.extras.get("columns", {})
    missing = [name for name in _POSE if name not in columns]
    if missing:
        raise NameMismatchError(f"{track / LANDMARKS}: found no {', '.join(missing)}, expected the head's pose")
    pose = torch.stack([columns[name] for name in _POSE], 1).double()
    seen = torch.isfinite(pose).all(1) & torch.isfinite(marks.landmarks.values).all(2).any(1)
    if not bool(seen.any()):
        raise ValueRangeError(f"{track}: found no frame with a face, expected some")
    pose = pose.nan_to_num(0.0)
    rig = bare(upright(load_rig(track / ANIMATION))[0])
    if not record["intrinsics"]:
        raise FileFormatError(f"{track / SUMMARY}: found no intrinsics, which older tracks lack; track the film again")
    lens = record["intrinsics"].tensor(3, 3), record["distortion"].tensor(5)
    calibration = CameraCalibration(*lens, video.width, video.height)
    weights = rig.weights_from(animation.weights)
    marks_found = marks.landmarks.values
    return TrackedFilm(video, rig, weights, head_rotations(pose[:, 3:]), pose[:, :3], marks_found, seen, calibration)


def bare(rig: BlendshapeRig) -> BlendshapeRig:
    """A rig without hair and clothes, which the film has its own of, and without lashes and shells that are clear,
    which would be painted over the eyes."""
    left_out = [mask for name, mask in rig.neutral.regions.items() if name.startswith(_GROWN) or _is_clear(name)]
    return rig.part(~torch.stack(left_out).any(0)) if left_out else rig


def _is_clear(region: str) -> bool:
    material = part_material(region)
    return material is not None and material.alpha == "BLEND"

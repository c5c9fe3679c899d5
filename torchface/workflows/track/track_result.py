"""Result of tracking a video, and its report."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import nan
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.own_rig import VideoSolution
from torchface.capture.own_rig.another_face import AnotherFace
from torchface.capture.own_rig.eye_geometry import Eyeballs
from torchface.capture.own_rig.head_pose import STABLE_LANDMARKS
from torchface.capture.own_rig.landmark_offsets import LandmarkOffsets
from torchface.capture.own_rig.take_eyes import TakeEyes
from torchface.capture.own_rig.weight_walk import HIDDEN
from torchface.escaped_text import listed
from torchface.geometry.cameras.calibration import CameraCalibration
from torchface.io.video import VideoFile
from torchface.io.video.film_sound import sound_line
from torchface.landmarks import FaceReading, landmark_jitter
from torchface.rig import BlendshapeRig
from torchface.workflows.track.person_head import PersonHead
from torchface.workflows.track.take_solution import OFFSETS
from torchface.workflows.track.track_inputs import TrackInputs

MIN_STABLE = 6
"""Stable landmarks that a pose needs."""
_POOR = 0.025  # of the distance of the eyes' outer corners; solved heads of rendered people are off by 1 to 2.3 %
_SURE, _MOST = 0.5, 0.9
_AT_BOUND, _OFTEN, _MAX_NAMED = 1e-3, 0.2, 5
_LEAST_MOTION = 1e-2  # mm²
_OWN_EYES = 2.0  # degrees
_MOST_OF_TIME = 0.4
_FROM_ONE = "its frames count from 1, those here and in weights.csv from 0"


@dataclass(frozen=True, eq=False)
class Tracked:
    """What came of a video."""

    inputs: TrackInputs
    reading: FaceReading  # the face in all frames, (T,...)
    landmarks: Tensor  # the reading's as a camera without distortion has them, filtered along time, (T,68,2), pixels
    solution: VideoSolution
    # when each frame is shown, (T,) seconds, where the frame rate varies; even at the video's if absent
    times: Tensor | None = None
    # between the rig's landmarks and those found; None where the take is too short for an estimate
    offsets: LandmarkOffsets | None = None
    faces: int = 0  # how many there are in the first frame
    reused: int = 0  # frames whose readings were known from an earlier run
    seconds: dict[str, float] = field(default_factory=dict)  # what each step took, by its name
    products: dict[str, Path] = field(default_factory=dict)  # the files, by what they are
    reductions: list[str] = field(default_factory=list)  # what few keys they have, in words, where few were asked for
    # landmarks that lie where no face has them, and so are not trusted, (T,68) bool; none if absent
    outliers: Tensor | None = None
    others: Sequence[AnotherFace] = ()  # spans of frames that show another face, which are not solved
    head: PersonHead | None = None  # the person's, where it was solved with the take
    eyes: TakeEyes | None = None  # what the frames show of the eyes; None where nobody looked at them
    cameras: Sequence[str] = ()  # the others that saw the take, a line each
    # some frames by their numbers, uint8 (3,H,W), for the report; it reads others from the video
    pictures: dict[int, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.landmarks)

    @property
    def video(self) -> VideoFile:
        """The video, or what stands for it."""
        return self.inputs.clip

    @property
    def rig(self) -> BlendshapeRig:
        """The actor's."""
        return self.inputs.actor

    @property
    def shown(self) -> BlendshapeRig:
        """The actor's with the skin that the video shows, where the head was solved with the take."""
        return self.rig if self.head is None or self.head.shown is None else self.head.shown

    @property
    def calibration(self) -> CameraCalibration:
        """Of the camera."""
        return self.inputs.calibration

    @property
    def camera_source(self) -> str:
        """What a camera is from, and its error; "assumed" where none was given."""
        file, error = self.inputs.settings.camera or self.inputs.settings.cameras, self.calibration.error
        if file is None and error is None:
            return "assumed"
        found = "as given" if file is None else f"from {file.name}"
        found += ", its focal length a guess by a face" if self.calibration.guessed else ""
        return f"{found}, " + ("of unknown error" if error is None else f"{error:.2f} px off when it was made")

    @property
    def finder(self) -> str:
        """What found the landmarks, by its name."""
        return Path(self.inputs.settings.landmarks).name

    @property
    def gaze(self) -> Tensor:
        """Where the eyes look beside the head, (T,2,2) radians to the person's left and up, right eye first; 0 where
        nobody knows."""
        weights = self.solution.weights.detach()
        if self.eyes is None:
            return weights.new_zeros(len(self), 2, 2)
        return self.eyes.turned(weights, self.rig.names, Eyeballs.of(self.rig)).nan_to_num(0.0)

    def seconds_at(self, frame: int) -> float:
        """When a frame is shown."""
        return frame / self.video.fps if self.times is None else float(self.times[frame])

    @cached_property
    def seen(self) -> Tensor:
        """Frames in which the face was found, (T,) bool."""
        return self.reading.found

    @property
    def stable(self) -> Tensor:
        """How many stable landmarks each frame shows, (T,)."""
        return torch.isfinite(self.reading.landmarks[:, list(STABLE_LANDMARKS)]).all(2).sum(1)

    @property
    def jitter(self) -> float:
        """How much the landmarks tremble, pixels."""
        marks = self.reading.landmarks
        return float(landmark_jitter(marks if self.outliers is None else marks.where(~self.outliers[..., None], nan)))

    def outlier_lines(self) -> list[str]:
        """Which landmarks lie where no face has them, if any."""
        if self.outliers is None or not bool(self.outliers.any()):
            return []
        places = self.outliers.nonzero().tolist()
        named = listed((f"landmark {mark} of frame {frame}" for frame, mark in places), _MAX_NAMED)
        frames = int(self.outliers.any(1).sum())
        return [
            f"{len(places)} landmarks in {frames} frames lie where no face has them and were left out: {named} "
            f"(landmarks.csv gives them a confidence of 0; {_FROM_ONE})"
        ]

    def suspect_spans(self) -> list[tuple[int, int, str]]:
        """First and last frame of each span with no face, with another, or with landmarks of low mean confidence."""
        reading = self.reading
        sure = (reading.confidence * reading.visibility).nan_to_num().mean(1) * reading.presence.nan_to_num()
        kind = torch.where(self.seen, (sure < _SURE).long(), 2)
        for span in self.others:
            kind[span.first : span.last + 1] = 3
        runs, counts = kind.unique_consecutive(return_counts=True)
        ends = counts.cumsum(0)
        return [
            (end - count, end - 1, ("", "low confidence", "no face", "another face")[run])
            for run, count, end in zip(runs.tolist(), counts.tolist(), ends.tolist(), strict=True)
            if run
        ]

    def bounds(self) -> Tensor:
        """The share of frames in which each weight is at 1, (N,)."""
        return (self.solution.weights >= 1 - _AT_BOUND).float().mean(0)

    @property
    def moves(self) -> Tensor:
        """The shapes that move landmarks, (N,) bool."""
        marks = self.rig.neutral.landmarks
        return self.rig.deltas[:, marks].detach().square().sum((1, 2)) > _LEAST_MOTION

    def hidden_share(self) -> Tensor:
        """The share of frames with a face in which each weight's landmarks are hidden, (N,)."""
        confidence = self.solution.confidence[self.seen.to(self.solution.confidence.device)]
        return (confidence < HIDDEN).float().mean(0)

    @property
    def misfit(self) -> float:
        """How far the solved face lies from the landmarks in the median frame, of the eyes' distance; NaN unseen."""
        off = torch.where(self.seen, self.solution.errors, torch.nan).nanmedian()
        corners = self.rig.vertices[self.rig.neutral.landmarks[[36, 45]]].double().detach()
        solved, K = self.solution, self.calibration.intrinsics.double()
        placed = (corners @ solved.rotation.double().mT + solved.translation.double()[:, None]) @ K.T
        seen = placed[..., :2] / placed[..., 2:]  # where the rig has them: dark glasses hide eyes in all frames
        return float(off / (seen[:, 0] - seen[:, 1]).norm(dim=1)[self.seen].median())

    def verdict(self) -> str:
        """Whether the result is to be used, in a line."""
        count, misfit = len(self), self.misfit
        another = sum(int(self.seen[span.first : span.last + 1].sum()) for span in self.others)
        seen = int(self.seen.sum()) - another
        found = f"the face was found in {seen} of {count} frames ({100 * seen / count:.1f} %)"
        found += f", another face in {another}" if another else ""
        if not seen:
            return f"result: none, {found}"
        fit = f"the solved face lies {100 * misfit:.1f} % of the eyes' distance from the landmarks"
        if misfit > _POOR:
            cameras = self.inputs.settings.cameras
            whose = (
                f"is the rig this person's own, and do the cameras lie as {cameras.name} says, in its order?"
                if cameras is not None
                else "is the rig this person's own? If not: track without --rig, then torchface retarget"
                if self.head is None
                else "does --rig with their own, or a model of people, do better?"
            )
            return f"result: poor, {fit} (at most {100 * _POOR:.3g} % is usual; {whose}); {found}"
        if seen < _MOST * count:
            return f"result: partly usable, {found}; there {fit} (at most {100 * _POOR:.3g} % is usual)"
        return f"result: good, {found}, and {fit} (at most {100 * _POOR:.3g} % is usual)"

    def lines(self) -> list[str]:
        """For people to read."""
        count, seen = len(self), int(self.seen.sum())
        errors = torch.where(self.seen, self.solution.errors, torch.nan)
        lines = [
            self.verdict(),
            f"{count} frames at {self.video.fps:g} a second; the landmarks tremble by {self.jitter:.2f} px from frame "
            f"to frame; the solved face lies {float(errors.nanmedian()):.2f} px from them in the median frame, and "
            f"less than {float(errors.nanquantile(0.95)):.2f} px in 95 % of the frames",
        ]
        about = self.inputs.about
        lines += [line for line in (about, *(() if self.head is None else self.head.lines())) if line]
        lines.extend((*self.reductions, *self.outlier_lines()))
        lines.extend(
            f"frames {span.first} to {span.last} show another face than the first frames (its look correlates by "
            f"{span.likeness:.2f}, eyes and nose lie {100 * span.apart:.1f} % of the eyes' distance apart): they are "
            "not solved and have no confidence (--one-person solves them)"
            for span in self.others
        )
        if self.video.pixel_aspect != 1:
            lines.append(
                f"anamorphic video: its pixels are {self.video.pixel_aspect:.3g} times as wide as high; landmarks and "
                f"camera are of its {self.video.width} x {self.video.height} square ones"
            )
        if self.video.interlaced:
            lines.append(
                "interlaced video: its frames are two fields, half a frame apart in time; each was made whole from its "
                "first field and those beside it (FFmpeg's bwdif), as overlay.mp4 shows them"
            )
        if self.times is not None:
            lines.append(
                f"variable frame rate: {self.inputs.rate_varies}; weights.csv, animation.glb and the overlay have the "
                "frames' own times"
            )
        if "overlay" in self.products:
            lines.extend(sound_line(self.video.path, self.products["overlay"]))
        if self.camera_source == "assumed":
            lines.append(
                f"camera: none given; assumed a field of view of {self.calibration.field_of_view:.0f} degrees "
                f"(focal length {float(self.calibration.intrinsics[0, 0]):.0f} px), so distances are rough "
                "(torchface calibrate measures it)"
            )
        else:
            lines.append(f"camera: {self.camera_source}")
        lines.extend(self.cameras)
        if self.faces > 1:
            lines.append(f"{self.faces} faces in the first frame; --face N picks another than the one followed")
        few = int((self.seen & (self.stable < MIN_STABLE)).sum())
        if few:
            lines.append(
                f"{few} frames show fewer than {MIN_STABLE} stable landmarks; their pose is that of other frames"
            )
        lost = count - seen
        if lost:
            lines.append(
                f"{lost} frames without a face: the head stays where it was; the expression stays for a third of a "
                "second and is at rest a second later, or with --whole-take lies between those before and after; "
                f"landmarks.csv says which (success 0; {_FROM_ONE})"
            )
        bounds = self.bounds()
        dark = self.hidden_share()
        rarely = [i for i in dark.argsort(descending=True).tolist() if dark[i] > _OFTEN and bool(self.moves[i])]
        if rarely:
            named = ", ".join(f"{self.rig.names[i]} {100 * float(dark[i]):.0f} %" for i in rarely[:_MAX_NAMED])
            lines.append(
                f"often hidden: {named} of the frames; there they follow the other side of the face, or keep "
                "their weight for a third of a second and then go to rest: do not take that for acting "
                "(confidence.csv says where)"
            )
        if self.offsets is not None:
            size = float(self.offsets.millimetres.norm(dim=1).mean())
            lines.append(
                f"the person's landmarks lie {size:.1f} mm from the rig's in the mean while the face rests; that was "
                f"taken for the shape of the face, not for acting (--offsets {OFFSETS} uses the same for other takes)"
            )
        if self.eyes is not None and self.eyes.straight is not None:
            side, up = self.eyes.straight.mean(0).rad2deg().tolist()
            if max(abs(side), abs(up)) >= _OWN_EYES:
                lines.append(
                    f"eyes: {abs(up):.0f} degrees {'up' if up > 0 else 'down'} and {abs(side):.0f} to the "
                    f"{'left' if side > 0 else 'right'} of a constant gaze were taken for the usual place of this "
                    "person's eyes, not for acting"
                )
        often = [i for i in bounds.argsort(descending=True).tolist() if bounds[i] > _OFTEN]
        if often:
            named = ", ".join(f"{self.rig.names[i]} {100 * float(bounds[i]):.0f} %" for i in often[:_MAX_NAMED])
            more = "a rig made by torchface fit with a photograph of this expression among others can go further"
            if self.head is None:
                why = f"the rig; {more}. If the rig is another person's: track without --rig, then torchface retarget"
            else:
                why = f"the head that was solved with the take; {more}: --rig takes it"
            lines.append(
                f"often at their maximum, 1: {named} of the frames; the face goes further than these shapes of {why}"
            )
        if unlearned := self.inputs.models.unlearned:
            lines.append(f"the priors have not learned {listed(unlearned)}: they hold these near rest")
        if self.reused:
            lines.append(f"landmarks of {self.reused} frames were known from an earlier run")
        if self.seconds:
            took = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in self.seconds.items())
            lines.append(f"time, start included: {took}; the film lasts {count / self.video.fps:.1f} s")
            if (overlay := self.seconds.get("overlay", 0.0)) > _MOST_OF_TIME * sum(self.seconds.values()):
                lines.append(
                    f"the overlay took {overlay / sum(self.seconds.values()):.0%} of it; --overlay none skips it"
                )
        return lines

"""Files of a tracked video: curves of weights, landmarks and head pose, offsets, animation, summary."""

from pathlib import Path

from torchface.files.whole_files import delete_file
from torchface.io.landmarks.openface_csv import save_landmarks_csv
from torchface.io.weights.live_link_csv import save_live_link
from torchface.io.weights.weight_csv import save_weights_csv
from torchface.landmarks.images.tracking.video_landmarks import LANDMARK_NAMES
from torchface.shape_names import ARKIT, mapping
from torchface.take import Take, Track
from torchface.workflows.head_rotations import rotation_columns
from torchface.workflows.track.take_solution import OFFSETS
from torchface.workflows.track.track_result import Tracked
from torchface.workflows.weight_files import reduced_take, write_animation

WEIGHTS, CONFIDENCE, LIVE_LINK, LANDMARKS = "weights.csv", "confidence.csv", "live_link.csv", "landmarks.csv"
ANIMATION, HEAD, OVERLAY, SUMMARY = "animation.glb", "head.glb", "overlay.mp4", "summary.json"

SUMMARY_FORMAT = "torchface.track-summary/1"


def save_curves(take: Take, out: Path) -> dict[str, Path]:
    """Writes a take's weights by the rig's names, and as Live Link Face has them, with the head, where names allow;
    gives the files by what they are."""
    assert take.weights is not None
    products = {"weights": out / WEIGHTS}
    save_weights_csv(take, out / WEIGHTS)
    if mapping(take.weights.names, ARKIT).any():
        products["live link"] = out / LIVE_LINK
        save_live_link(take, out / LIVE_LINK)
    else:
        delete_file(out / LIVE_LINK)  # one of an earlier run is of another rig
    return products


def write_curves(tracked: Tracked, out: Path) -> dict[str, Path]:
    """Writes the weights, how sure they are, the landmarks with the head's pose beside them, the offsets and the
    animation; gives the files by what they are.

    How sure each weight is stands in a file of its own, arranged as the weights are: a column beside them would be a
    shape to whatever else reads them, and could not say which part of the face is hidden.
    """
    fps, weights = tracked.video.fps, tracked.solution.weights.detach().float()
    angles = rotation_columns(tracked.solution.rotation, tracked.gaze)
    when = tracked.times
    take = Take(fps, weights=Track(tracked.rig.names, weights[..., None]), extras={"columns": angles}, seconds=when)
    bound, few = tracked.inputs.settings.reduce, take
    if bound is not None:
        few, reduction = reduced_take(take, bound)
        tracked.reductions.append(f"{WEIGHTS}: {reduction}")
    products = {**save_curves(few, out), "landmarks": out / LANDMARKS, "animation": out / ANIMATION}
    products["confidence"] = out / CONFIDENCE
    sure = tracked.solution.confidence.detach().float() * tracked.seen[:, None]
    save_weights_csv(Take(fps, weights=Track(tracked.rig.names, sure[..., None]), seconds=when), products["confidence"])
    if tracked.offsets is None:
        delete_file(out / OFFSETS)
    else:
        products["offsets"] = out / OFFSETS
        tracked.offsets.save(out / OFFSETS)
    moved = tracked.solution.translation.detach().double()
    columns = {f"pose_T{axis}": moved[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"pose_{name.removeprefix('Head').lower()}": angles[name] for name in list(angles)[:3]}
    reading = tracked.reading
    for kind in ("confidence", "visibility"):
        each = getattr(reading, kind)
        columns |= {f"{kind}_{name}": each[:, i] for i, name in enumerate(LANDMARK_NAMES)}
    columns["presence"] = reading.presence
    track = Track(LANDMARK_NAMES, reading.landmarks, reading.confidence)
    save_landmarks_csv(Take(fps, landmarks=track, extras={"columns": columns}, seconds=when), products["landmarks"])
    own = tracked.products.get("head", tracked.inputs.rig if tracked.shown is tracked.rig else None)
    reduced = write_animation(tracked.shown, take, products["animation"], bound, own)
    if reduced is not None:
        tracked.reductions.append(f"{ANIMATION}: {reduced}")
    return products


def summary(tracked: Tracked) -> dict[str, object]:
    """The figures as JSON has them."""
    errors = tracked.solution.errors
    return {
        "format": SUMMARY_FORMAT,
        "video": tracked.video.path.name,
        "frames": len(tracked),
        "fps": tracked.video.fps,
        "found": int(tracked.seen.sum()),
        "landmarks_found_by": tracked.finder,
        "landmarks_left_out": 0 if tracked.outliers is None else int(tracked.outliers.sum()),
        "frames_of_another_face": sum(span.last - span.first + 1 for span in tracked.others),
        "jitter_px": tracked.jitter,
        "reprojection_median_px": float(errors.nanmedian()),
        "reprojection_95_px": float(errors.nanquantile(0.95)),
        "camera_assumed": tracked.camera_source == "assumed",
        "focal_px": float(tracked.calibration.intrinsics[0, 0]),
        "intrinsics": tracked.calibration.intrinsics.tolist(),
        "distortion": tracked.calibration.distortion.tolist(),
        "faces_in_first_frame": tracked.faces,
        "seconds": tracked.seconds,
        "files": {name: path.name for name, path in tracked.products.items()},
    }

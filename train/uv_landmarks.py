"""``python -m train.uv_landmarks --scans DIR --annotations FILE --out models/uv_landmarks``: landmarks of raw scans."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch
import tyro

from torchface import Mesh, TorchfaceError, load_mesh
from torchface.files import write_file
from torchface.landmarks import (
    TWELVE,
    CylinderLayout,
    DetectorSettings,
    FaceFrame,
    ScanAnnotation,
    UVLandmarkDetector,
    appearance_image,
    load_annotations,
    save_detector,
    scan_landmarks,
    unwrap,
)
from torchface.landmarks.evaluation import ScanErrors, error_table, landmark_errors, picture
from torchface.rendering.compositing import save_picture, sheet


@dataclass(frozen=True)
class Settings:
    """What the recipe does.

    Args:
        scans: Folder of scans (.obj, .ply, .stl, .glb), in any pose, in millimetres.
        annotations: JSON with the landmarks of each scan by file name.
        out: Folder for the model, its card and its pictures.
        appearance: What the detector looks at: the scans' colours, or their form.
        held_out: How many scans, the last by name, are kept for the test.
        size: Pixels a side of the unwrapped pictures.
        detector: How landmarks are matched.
    """

    scans: Path
    annotations: Path
    out: Path = Path("models/uv_landmarks")
    appearance: Literal["texture", "relief"] = "relief"
    held_out: int = 0
    size: int = 1024
    detector: DetectorSettings = field(default_factory=DetectorSettings)


@dataclass(frozen=True, eq=False)
class Trained:
    """A detector and its errors on the scans held out."""

    detector: UVLandmarkDetector
    errors: list[ScanErrors]


def train(settings: Settings, say: Callable[[str], None] | None = None) -> Trained:
    """Loads, aligns, splits, fits, evaluates and saves.

    Raises:
        TorchfaceError: no scan is annotated, or a scan or the annotations cannot be used.
    """
    say = say or (lambda line: None)
    annotations = load_annotations(settings.annotations)
    names = sorted(annotations)
    if len(names) - settings.held_out < 2:
        raise TorchfaceError(
            f"{settings.annotations}: found {len(names)} annotated scans, expected at least two besides the "
            f"{settings.held_out} held out"
        )
    split = len(names) - settings.held_out
    scans = [load_mesh(settings.scans / name) for name in names]
    say(f"{split} scans to learn from, {settings.held_out} to test on")
    detector = fit(scans[:split], [annotations[name] for name in names[:split]], settings, say)
    errors, pictures = [], []
    for name, scan in zip(names[split:], scans[split:], strict=True):
        found = scan_landmarks(detector, scan)
        errors.append(landmark_errors(found, scan, annotations[name], name))
        pictures.append(picture(found, annotations[name]))
        say(f"{name}: {errors[-1].mean_pixels:.1f} px")
    save(detector, settings, errors, names[:split])
    if pictures:
        save_picture(sheet(pictures[:9], 3), settings.out / "held_out.png")
    return Trained(detector, errors)


def fit(
    scans: list[Mesh], annotations: list[ScanAnnotation], settings: Settings, say: Callable[[str], None]
) -> UVLandmarkDetector:
    """Learns the face frame, unwraps every scan as it will be found again, learns the filters."""
    points = torch.stack([annotation.twelve() for annotation in annotations])
    say("learning the face frame")
    frame = FaceFrame.fit(scans, points)
    layout = CylinderLayout().resized(settings.size)
    images, pixels, lines = [], [], []
    for scan, truth, annotation in zip(scans, points, annotations, strict=True):
        head = unwrap(scan, frame.locate(scan), layout)
        images.append(appearance_image(head, settings.appearance))
        pixels.append(layout.pixels(head.pose.apply(truth[None])[0]))
        lines.append({name: layout.pixels(head.pose.apply(line[None])[0]) for name, line in annotation.lines.items()})
        say(f"unwrapped {len(images)} of {len(scans)}")
    return UVLandmarkDetector.fit(
        torch.stack(images),
        torch.stack(pixels).float(),
        TWELVE,
        settings.appearance,
        settings.detector,
        frame,
        lines,
        lambda done, total: say(f"scored {done} of {total}"),
    )


def save(detector: UVLandmarkDetector, settings: Settings, errors: list[ScanErrors], names: list[str]) -> None:
    """Writes the model with its effective settings, measured errors and card."""
    table = error_table(errors)
    effective = asdict(replace(settings, scans=Path(settings.scans.name), annotations=Path(settings.annotations.name)))
    effective.update({key: str(value) for key, value in effective.items() if isinstance(value, Path)})
    save_detector(detector, settings.out, {"settings": effective, "errors": table})
    rows = "\n".join(f"| {key} | {value:.2f} |" for key, value in table.items())
    card = (
        f"# UV landmarks ({settings.appearance})\n\n"
        f"Twelve face landmarks, lip and lid lines of raw scans. Learned from {len(names)} annotated scans, "
        f"tested on {len(errors)} others.\n\n| measured | value |\n| --- | --- |\n{rows}\n"
    )
    write_file(settings.out / "CARD.md", card.encode())


def main() -> None:
    """Parses flags, trains, prints."""
    trained = train(tyro.cli(Settings, description=__doc__), print)
    for key, value in error_table(trained.errors).items():
        print(f"{key:40} {value:8.2f}")


if __name__ == "__main__":
    main()

"""``torchface train uv_landmarks --scans DIR --annotations FILE --out models/NAME``: landmarks of raw scans.

``--performers 30`` learns from scans of so many embedded performers instead, and needs no file.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch

from torchface import TorchfaceError, zoo
from torchface.landmarks import (
    UV_LANDMARK_NAMES,
    CylinderLayout,
    DetectorSettings,
    FaceFrame,
    LineExamples,
    UVLandmarkDetector,
    appearance_image,
    line_image,
    scan_landmarks,
    unwrap,
)
from torchface.progress import Progress, silent
from torchface.rendering.compositing import save_rendered_image, sheet

from .annotated_scans import AnnotatedScan, annotated_scans, scanned_performers, shown_people
from .model_cards import model_card
from .people_split import held_out_people
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, metric_lines, recipe
from .scan_landmark_errors import ScanErrors, draw_result, error_table, landmark_errors

_TESTED_PERFORMERS = 20


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        scans: Folder of scans (.obj, .ply, .stl, .glb), in any pose, in millimetres.
        annotations: JSON with the landmarks of each scan by file name.
        performers: Learn from scans of so many embedded performers instead of a folder's.
        appearance: What the detector looks at: the scans' colours, or their form.
        held_out: How many scans, the last by name, are kept for the test, with all others in the same folder, which
            show the same person; or how many more performers are drawn for it. None if absent, and 20 performers.
        size: Pixels a side of the unwrapped images.
        detector: How landmarks are matched.
    """

    scans: Path | None = None
    annotations: Path | None = None
    performers: int = 0
    out: Path = Path("models/uv_landmarks")
    appearance: Literal["texture", "curvature"] = "texture"
    held_out: int | None = None
    seed: int = 7
    size: int = 1024
    detector: DetectorSettings = field(default_factory=DetectorSettings)


@dataclass(frozen=True, eq=False)
class Trained:
    """A detector and its errors on the scans held out."""

    detector: UVLandmarkDetector
    errors: list[ScanErrors]


@recipe
def train(settings: Settings, run: Run) -> Trained:
    """Loads, aligns, splits, fits, evaluates and saves."""
    progress = run.progress
    learn, test = _split(settings, progress)
    progress(f"{len(learn)} scans to learn from, {len(test)} to test on")
    detector = fit(learn, settings.appearance, settings.size, settings.detector, progress)
    errors, pictures = [], []
    for scan in test:
        landmarks = scan_landmarks(detector, scan.mesh)
        errors.append(landmark_errors(landmarks, scan.mesh, scan.truth, scan.name))
        pictures.append(draw_result(landmarks, scan.truth))
        progress(f"{scan.name}: {errors[-1].mean_pixels:.1f} px")
    save(detector, settings, errors, len(learn))
    if pictures:
        save_rendered_image(sheet(pictures[:9], 3), settings.out / "held_out.png")
    return Trained(detector, errors)


def fit(
    scans: list[AnnotatedScan],
    appearance: Literal["texture", "curvature"] = "texture",
    size: int = 1024,
    detector: DetectorSettings | None = None,
    progress: Progress | None = None,
) -> UVLandmarkDetector:
    """Learns the face frame, unwraps every scan as it will be found again, learns the filters and the lines."""
    progress = progress or silent
    points = torch.stack([scan.truth.ordered() for scan in scans])
    progress("learning the face frame")
    frame = FaceFrame.fit([scan.mesh for scan in scans], points)
    layout = CylinderLayout().resized(size)
    images, traced, pixels, lines = [], [], [], []
    for scan, truth in zip(scans, points, strict=True):
        head = unwrap(scan.mesh, frame.locate(scan.mesh), layout)
        images.append(appearance_image(head, appearance))
        traced.append(line_image(head, appearance))
        pixels.append(layout.pixels(head.pose.apply(truth[None])[0]))
        known = scan.truth.lines.items()
        lines.append({name: layout.pixels(head.pose.apply(line[None].double())[0]) for name, line in known})
        progress("unwrapping scans", len(images), len(scans))
    return UVLandmarkDetector.fit(
        torch.stack(images),
        torch.stack(pixels).float(),
        UV_LANDMARK_NAMES,
        appearance,
        detector,
        frame,
        LineExamples(lines, torch.stack(traced)),
        progress,
    )


def save(detector: UVLandmarkDetector, settings: Settings, errors: list[ScanErrors], count: int) -> None:
    """Writes the model with its effective settings, measured errors and card."""
    if settings.performers:
        data = f"{count} scans of the embedded performer; no person's face."
    else:
        data = f"{count} annotated scans of {settings.scans and settings.scans.name}."
    seen = "colours" if settings.appearance == "texture" else "form"
    pitch = CylinderLayout().resized(settings.size).pitch
    card = model_card(
        settings,
        licence="MIT" if settings.performers else "that of the scans",
        data=data,
        metrics=error_table(errors),
        text=(
            f"Twelve face landmarks, lip and lid lines of raw scans, found by their {seen}. Tested on {len(errors)} "
            f"other scans; pixels are those of the unwrapped head, {settings.size} a side, {pitch:g} mm each. Lids are "
            "traced where they meet in scans with closed eyes."
        ),
    )
    zoo.save_model(detector, settings.out, card)


def _split(settings: Settings, progress: Progress) -> tuple[list[AnnotatedScan], list[AnnotatedScan]]:
    """Scans to learn from, and those to test on."""
    given = settings.scans is not None and settings.annotations is not None
    if given == (settings.performers > 0):
        raise TorchfaceError(
            f"found --scans {settings.scans}, --annotations {settings.annotations}, --performers "
            f"{settings.performers}; expected scans with their annotations, or a number of performers"
        )
    if settings.scans is None or settings.annotations is None:
        more = _TESTED_PERFORMERS if settings.held_out is None else settings.held_out
        scans = scanned_performers(settings.performers + more, settings.seed, progress)
        return scans[: settings.performers], scans[settings.performers :]
    known = annotated_scans(settings.scans, settings.annotations)
    people = shown_people([scan.name for scan in known])
    learn, test = held_out_people(people, settings.held_out or 0)
    if len(learn) < 2:
        raise TorchfaceError(
            f"{settings.annotations}: found {len(known)} annotated scans, expected at least two besides the "
            f"{len(test)} held out"
        )
    return [known[number] for number in learn], [known[number] for number in test]


RECIPE = Recipe(Settings, train, __doc__, lambda _, trained: metric_lines(error_table(trained.errors), "8.2f"))

if __name__ == "__main__":
    RECIPE.main()

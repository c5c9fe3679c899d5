"""``torchface train enhancement --frames DIR --out models/NAME``: an actor's fine detail and timing, as captured.

``DIR`` holds sequences from the neutral to an expression and back, all of one topology: folders of OBJ or PLY meshes,
``.glb`` animations, ``.npz`` files, and ``neutral.obj``; vertex colours of meshes are learned
too. ``--performer 20000`` learns from the embedded performer with so many vertices and planted wrinkles, and needs no
file. Killed and started again, a run goes on where it was.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from torchface import TorchfaceError, zoo
from torchface.enhancement import CapturedPerformance, EnhancementModel, EnhancementSettings
from torchface.enhancement.detail.low_pass import WAVELENGTH
from torchface.errors import AlignmentError, ValueRangeError
from torchface.io import MeshSequence
from torchface.workflows.animated_meshes import DEFAULT_FPS
from torchface.workflows.enhance.coarse_animation import (
    NO_HEAD_MM,
    OWN_HEAD_MM,
    SAMPLED,
    distance_at_rest,
    residual_notes,
)

from .captured_sequences import Capture, gather, performed, read_capture, read_pairs
from .enhancement_figures import draw
from .model_cards import model_card
from .recipe_settings import RecipeSettings
from .restored_frames import Shown, measured
from .runner import Recipe, Run, recipe


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        frames: Folder of sequences: folders of meshes, .glb, .npz or .safetensors files, or meshes named
            sequence_0001.obj; millimetres, or the unit of their file.
        coarse: Folder of what a coarse animation shows of the same frames, in the model's topology and the same places:
            sequences of the same names and lengths (`torchface enhance ... --detail 0` writes such meshes). Then what
            that kind of input lacks or gets wrong is learned, for such inputs; the more it errs the more that gains.
        neutral: The neutral as a mesh; with landmarks (see `torchface annotate`) regions are named and eyes set apart.
            neutral.* in the folder if absent.
        performer: Learn from the embedded performer with so many vertices instead.
        fps: Of the frames; as their files say if absent, 30 where none does.
        held_out: How many sequences, the last, are kept for the test; if not said two, but at most half.
        wavelength: Of what counts as fine, millimetres: half of a wave of this length is detail.
        patch: Vertices a patch, in the mean of which frames are compared.
        regions: How many regions are looked for.
        rank: Components of the detail that are kept.
        detail: As displacements of vertices, or as gradients of triangles (the paper's).
        matching: How detail is found: by the projection onto the database alone (the paper's), or with a learned map.
    """

    frames: Path | None = None
    coarse: Path | None = None
    neutral: Path | None = None
    performer: int = 0
    out: Path = Path("models/enhancement")
    fps: float | None = None
    held_out: int | None = None
    wavelength: float = WAVELENGTH
    patch: int = 100
    regions: int = 13
    rank: int = 64
    detail: Literal["displacements", "gradients"] = "displacements"
    matching: Literal["learned", "projection"] = "learned"


@recipe
def train(settings: Settings, run: Run) -> EnhancementModel:
    """Gathers, learns, tests, saves and draws."""
    progress = run.progress
    capture = _capture(settings)
    fps = settings.fps or capture.fps or DEFAULT_FPS
    count = len(capture.sequences)
    held_out = min(2, count // 2) if settings.held_out is None else settings.held_out
    learned = count - held_out
    if held_out < 0 or learned < 1:
        raise ValueRangeError(f"--held-out: found {held_out} of {count} sequences, expected at least one to learn from")
    work = run.work
    pairs = _pairs(settings, capture)

    def gathered(name: str, begin: int, end: int) -> tuple[Shown, Tensor]:
        known, numbers = gather(capture.part(begin, end), work / f"{name}.safetensors", progress)
        shown = None if pairs is None else gather(pairs.part(begin, end), work / f"{name}_coarse.safetensors", progress)
        return Shown(known, None if shown is None else shown[0]), numbers

    part = capture.part(0, learned)
    colors = gather(part, work / "learned_colors.safetensors", progress, colors=True)[0] if part.colored else None
    known, numbers = gathered("learned", 0, learned)
    test = gathered("tested", learned, count)[0] if held_out else None
    if settings.frames is not None:
        shown = [known] if test is None else [known, test]
        _warn_of_another_person(capture, [part.truth for part in shown], settings.frames)
        if pairs is not None and settings.coarse is not None:
            coarse = [part.coarse for part in shown if part.coarse is not None]
            _warn_of_another_person(pairs, coarse, settings.coarse)
            _check_places(shown, settings)
    tested = 0 if test is None else len(test)
    progress(f"{len(known)} frames of {learned} of {count} sequences to learn from, {tested} to test on")
    mesh = capture.neutral
    model = EnhancementModel.fit(
        CapturedPerformance(
            known.truth,
            mesh.faces,
            numbers,
            mesh.vertices,
            coarse=known.coarse,
            colors=colors,
            landmarks=None if mesh.annotations is None else mesh.annotations.landmarks,
        ),
        EnhancementSettings(fps, settings.wavelength, settings.detail, settings.matching),
        patch_size=settings.patch,
        region_count=settings.regions,
        rank=settings.rank,
        seed=settings.seed,
        folder=work,
        progress=progress,
    )
    metrics = measured(model, known, test, progress)
    _warn_if_worse(metrics)
    save(model, settings, metrics, len(known), learned)
    draw(model, mesh, known, test, settings.out / "pictures", progress)
    return model


def _warn_of_another_person(capture: Capture, gathered: list[MeshSequence], folder: Path) -> None:
    """Looks for a face at rest in each sequence, as ``torchface enhance`` does in its input."""
    frames = [(part, number) for part in gathered for number in range(len(part))]
    begin, far = 0, list[str]()
    for sequence in capture.sequences:
        some = frames[begin : begin + sequence.count : max(1, sequence.count // SAMPLED)]
        at_rest = torch.cat([part.read(number, number + 1) for part, number in some])
        distance = distance_at_rest(at_rest, capture.neutral.vertices, folder / sequence.name)
        residual_notes(distance, folder / sequence.name)
        if distance > OWN_HEAD_MM:
            far.append(f"{sequence.name} {distance:.1f} mm")
        begin += sequence.count
    if far:
        warnings.warn(
            f"{folder}: {len(far)} of {len(capture.sequences)} sequences come no nearer to the neutral than "
            f"{', '.join(far[:5])} (root mean square), expected at most {OWN_HEAD_MM:g} mm: they show another "
            "person, whose head would be learned as an expression, or no face at rest",
            stacklevel=3,
        )


def _check_places(shown: list[Shown], settings: Settings) -> None:
    """Refuses coarse heads elsewhere than the captured ones: the way between would be learned as their error."""
    ways = [
        (part.coarse.read(number, number + 1) - part.truth.read(number, number + 1)).mean((0, 1)).norm()
        for part in shown
        if part.coarse is not None
        for number in range(0, len(part), max(1, len(part) // SAMPLED))
    ]
    apart = float(torch.stack(ways).median())
    if apart > NO_HEAD_MM:
        raise AlignmentError(
            f"{settings.coarse}: found heads {apart:.0f} mm from those of {settings.frames} (median of the frames), "
            f"expected the same places: at most {NO_HEAD_MM:g} mm"
        )


def _warn_if_worse(metrics: dict[str, float]) -> None:
    for name, share in metrics.items():
        if name.startswith("held out: missing detail, of ") and share >= 1:
            shown = name.removeprefix("held out: missing detail, of ").removesuffix("'s").removesuffix("'")
            warnings.warn(
                f"sequences held out: found errors {share:.2f} times those of {shown}, expected less than 1: the model "
                "makes animations worse that are unlike what it has learned; it needs sequences of more expressions",
                stacklevel=3,
            )


def _capture(settings: Settings) -> Capture:
    if (settings.frames is None) == (settings.performer == 0):
        raise TorchfaceError("found neither frames nor a performer, or both; expected one: --frames or --performer")
    if settings.frames is None:
        try:
            return performed(settings.performer, settings.seed, settings.fps or DEFAULT_FPS)
        except ValueRangeError as error:
            raise ValueRangeError(f"--performer: {error}") from None
    capture = read_capture(settings.frames, settings.neutral)
    capture.check_rate(settings.fps)
    return capture


def _pairs(settings: Settings, capture: Capture) -> Capture | None:
    """What a coarse animation shows of a capture."""
    if settings.coarse is None:
        return None
    if settings.frames is None:
        raise TorchfaceError("found --coarse with --performer, expected it beside --frames, of the same sequences")
    pairs = read_pairs(settings.coarse, capture)
    pairs.check_rate(settings.fps or capture.fps)
    return pairs


def save(model: EnhancementModel, settings: Settings, metrics: dict[str, float], frames: int, sequences: int) -> None:
    """Writes the model with its effective settings, what was measured, and its card."""
    if settings.frames is None:
        data = f"{frames} frames of {sequences} expressions of the embedded performer with planted wrinkles; no person."
    else:
        data = f"{frames} captured frames; sequences: {sequences}."
    named = ", ".join(model.region_names)
    card = model_card(
        settings,
        licence="MIT" if settings.frames is None else "that of the capture",
        data=data,
        metrics=metrics,
        text=(
            f"Gives coarse animations on {len(model.neutral)} vertices the wrinkles, creases and timing of one actor: "
            "`torchface enhance INPUT --model THIS --out DIR`. Detail is what lies beyond a smooth part "
            f"({model.settings.wavelength:.0f} mm keep half); it is looked up by region ({named}). The figures compare "
            "restored frames with captured ones, in shares of what the model is shown lacks: of sequences that it has "
            "learned from, and of others. It knows no expression that the actor did not show: regions outside the "
            "database get the nearest detail."
            + (" Its detail is what one kind of coarse input lacks: it is for that kind." if model.keeps_input else "")
        ),
    )
    zoo.save_model(model, settings.out, card, half=("database_features", "region_weights"))


RECIPE = Recipe(Settings, train, __doc__)

if __name__ == "__main__":
    RECIPE.main()

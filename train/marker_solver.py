"""``torchface train marker_solver --out models/NAME``: the solve of one rig and one marker layout, ready to load.

Without a rig it is that of the embedded performer with 100 markers.
"""

from dataclasses import dataclass
from pathlib import Path

import torch

from torchface import Attachment, BlendshapeRig, load_rig, zoo
from torchface.capture import MarkerSolver
from torchface.capture.markers.marker_solver import RIDGE, SPARSITY
from torchface.shape_names import mapping
from torchface.synthetic import performer
from torchface.synthetic.stages import perform, place_markers

from .model_cards import model_card
from .recipe_settings import RecipeSettings
from .runner import Recipe, Run, recipe


@dataclass(frozen=True, kw_only=True)
class Settings(RecipeSettings):
    """What the recipe does.

    Args:
        rig: A .glb, a folder of OBJ files, or ICT-FaceKit's FaceXModel folder; the embedded performer if absent.
        attachment: Where the markers sit, as JSON; placed over the face if absent.
        part: Keep this region of the rig only, such as face.
        markers: How many are placed.
        sparsity: Price of an active shape, mm² a marker.
        ridge: Price of a squared weight, mm² a marker.
        noise: Of the markers in the test, millimetres a coordinate.
        frames: Of the synthetic take of the test.
    """

    rig: Path | None = None
    attachment: Path | None = None
    out: Path = Path("models/marker_solver")
    part: str | None = None
    markers: int = 100
    sparsity: float = SPARSITY
    ridge: float = RIDGE
    noise: float = 0.3
    frames: int = 600


@recipe
def train(settings: Settings, run: Run) -> MarkerSolver:
    """Builds the solver, tests it on a synthetic take, saves it."""
    progress = run.progress
    progress("reading the rig")
    rig = performer(texture=False) if settings.rig is None else load_rig(settings.rig, part=settings.part)
    attachment = (
        place_markers(rig, settings.markers) if settings.attachment is None else Attachment.load(settings.attachment)
    )
    solver = MarkerSolver(rig, attachment, sparsity=settings.sparsity, ridge=settings.ridge)
    progress("solving a synthetic take")
    metrics = measure(solver, rig, settings)
    own = "the embedded performer" if settings.rig is None else settings.rig.name
    card = model_card(
        settings,
        licence="MIT" if settings.rig is None else "that of the rig",
        data=f"The rig of {own}, {len(solver.names)} shapes, {len(solver.labels)} markers; no person's face.",
        metrics=metrics,
        text=(
            "Weights of blendshapes from 3D markers in millimetres, NaN for not seen; every frame on its own, the "
            "exact minimum. Good for takes of this rig with this layout, in its space; another actor needs another "
            "one. "
            f"Measured on a synthetic take of {settings.frames} frames with {settings.noise} mm of noise a coordinate. "
            "Shapes that no marker sees, such as where the eyes look, stay at rest."
        ),
    )
    zoo.save_model(solver, settings.out, card)
    return solver


def measure(solver: MarkerSolver, rig: BlendshapeRig, settings: Settings) -> dict[str, float]:
    """Errors of weights, markers and the whole mesh on a synthetic take."""
    generator = torch.Generator().manual_seed(settings.seed)
    track = perform(settings.frames, generator).weights
    assert track is not None
    truth = track.values[..., 0] @ mapping(track.names, rig.names).T
    markers = solver.rest + torch.einsum("mcn,bn->bmc", solver.basis, truth)
    seen = markers + settings.noise * torch.randn(markers.shape, generator=generator)
    solved = solver(seen)
    pairs = zip(solved.split(50), truth.split(50), strict=True)
    away = torch.cat([(rig(a) - rig(b)).norm(dim=-1).mean(1) for a, b in pairs])
    return {
        "mean error of a weight": float((solved - truth).abs().mean()),
        "root mean square of a marker's distance, mm": float(solver.squared_distance(seen, solved).mean().sqrt()),
        "mean distance of a vertex, mm": float(away.mean()),
    }


RECIPE = Recipe(Settings, train, __doc__)

if __name__ == "__main__":
    RECIPE.main()

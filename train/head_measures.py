"""Measures of a head model: on heads held out, on heads left out in turn, and of its random heads."""

import torch

from torchface.geometry.sample_batches import Samples, blocks
from torchface.modeling import HeadModel, MorphableModel

from .model_quality import ModelQuality, model_quality
from .sample_views import SampleRange

_MEASURED = 500  # heads; leaving one out takes an eigensystem of so many for each


def head_quality(heads: Samples, count: int, components: int, seed: int) -> ModelQuality | None:
    """Curves of generalisation and specificity of the first so many heads; None of fewer than three."""
    if count < 3:
        return None
    some = min(count, _MEASURED)
    generator = torch.Generator().manual_seed(seed)
    numbers = _spread(range(1, min(some - 2, components) + 1))
    return model_quality(SampleRange(heads, 0, some), numbers, generator=generator)


def cross_validated(heads: Samples, folds: int, components: int | None) -> dict[str, float]:
    """How far heads lie from models of the others: each is left out once, in so many turns.

    All heads were aligned together.
    """
    samples = torch.cat([heads.read(*block) for block in blocks(heads)])
    fold_of = torch.arange(len(samples)) % folds
    far, mean = [], []
    for fold in range(folds):  # a model a turn
        others, left = samples[fold_of != fold], samples[fold_of == fold]
        model = MorphableModel.fit(others, None if components is None else min(components, len(others) - 1))
        far.append((model(model.project(left)) - left).norm(dim=-1).mean(1))
        mean.append((left - model.mean).norm(dim=-1).mean(1))
    each, base = torch.cat(far), torch.cat(mean)
    return {
        "left out in turn, heads": float(len(each)),
        "left out in turn, mean error mm": float(each.mean()),
        "left out in turn, worst head mm": float(each.max()),
        "left out in turn, of the mean head's error": float(each.mean() / base.mean()),
    }


def measured(
    model: HeadModel, quality: ModelQuality | None, test: Samples, test_colors: Samples | None
) -> dict[str, float]:
    """What goes into the card: millimetres and shares."""
    metrics = {"shape components": float(model.shape.count), "shape variance held": float(model.shape.explained[-1])}
    if test.shape[0]:
        far = [
            (model.shape(model.shape.project(part)) - part).norm(dim=-1)
            for part in (test.read(*block) for block in blocks(test))
        ]
        mean = [(part - model.shape.mean).norm(dim=-1) for part in (test.read(*block) for block in blocks(test))]
        metrics["held out, mean error mm"] = float(torch.cat(far).mean())
        metrics["held out, of the mean head's error"] = float(torch.cat(far).mean() / torch.cat(mean).mean())
    if quality is not None:
        metrics["generalisation mm"] = float(quality.generalisation[-1])
        metrics["specificity mm"] = float(quality.specificity[-1])
        metrics["nearest samples mm"] = quality.nearest
    if model.color is not None:
        metrics["color components"] = float(model.color.count)
        metrics["color variance held"] = float(model.color.explained[-1])
        if test_colors is not None and test_colors.shape[0]:
            parts = [test_colors.read(*block) for block in blocks(test_colors)]
            errors = [(model.color(model.color.project(part)) - part).abs() for part in parts]
            metrics["held out, mean color error"] = float(torch.cat(errors).mean())
    return metrics


def _spread(numbers: range, most: int = 60) -> list[int]:
    """At most so many of the numbers, first and last among them."""
    if len(numbers) <= most:
        return list(numbers)
    return sorted({numbers[round(i)] for i in torch.linspace(0, len(numbers) - 1, most).tolist()})


def card_text(model: HeadModel, tested: str) -> str:
    """What the model is good for, and its limits."""
    colors = (
        "Colours are one a vertex, sRGB; a cast that the whole set shares remains, and so does light from the side."
        if model.color is not None
        else "The meshes brought no colours, so the model has none."
    )
    carried = f"A rig of {len(model.rig_names)} shapes travels with it. " if model.rig_names else ""
    return (
        f"Neutral heads as a linear model: a mean and {model.shape.count} components, coefficients in standard "
        "deviations, millimetres. Good for drawing heads, for holding a registration or a fit to photographs to "
        f"what heads look like, for filling in what a scan does not show. {colors} {carried}{tested} It "
        "knows no heads unlike those it has learned from: beyond 3 standard deviations it only guesses."
    )

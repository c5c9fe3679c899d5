"""Claim: two rendered pictures of a person, read by the zoo's network, give heads nearer to the truth than the mean.

People of ICT-FaceKit's modes, each from the front and from three quarters with another expression, 288 pixels, another
focal length each, which `fit` is not given. Errors are mean distances after the best similarity: of the face region,
and of the 520 points that the network finds. The nearest head is looked for among the fits to all other pictures.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.geometry.cameras.pinhole import look_at
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_identity_modes
from torchface.io.rigs.ict_facekit import region
from torchface.landmarks import FaceReading
from torchface.modeling import FitSettings, ImageFit, fit_images
from torchface.workflows.fit.fit_landmarks import find_in_photographs
from torchface.workflows.fit.fit_readings import with_readings
from torchface.workflows.named_priors import DEFAULT_PRIOR, load_priors
from torchface.workflows.surface_sites import sites_on_rig
from train.face_pictures import head_kinds
from train.morphable import ict_head_model
from train.rendered_people.backdrops import uniform
from train.rendered_people.expressions import people_expression
from train.rendered_people.head_kind import DrawnHead
from train.rendered_people.looks import draw_looks
from train.rendered_people.people import Person, closed_lids
from train.rendered_people.picture_geometry import surface
from train.rendered_people.rendered_person import render_person

pytestmark = pytest.mark.real

PEOPLE, SIZE = 20, 288
WAYS = {"front": (0,), "three-quarter": (1,), "both": (0, 1)}


@dataclass(frozen=True, eq=False)
class Pictured:
    """Someone's coefficients (K,) and two pictures, (3,288,288) each."""

    coefficients: Tensor
    pictures: tuple[Tensor, Tensor]


def people(folder: Path) -> list[Pictured]:
    kind, modes = head_kinds(folder)[0][0], load_identity_modes(folder)
    rest = modes.neutral.vertices
    deltas = ict_head_model(folder).rig
    result = []
    for number in range(PEOPLE):
        generator = torch.Generator().manual_seed(31_000_000 + number)
        coefficients = torch.randn(len(modes.names), generator=generator).clamp(-2.5, 2.5)
        head = DrawnHead(rest + torch.tensordot(coefficients, modes.deltas, dims=1), deltas.deltas)
        who = Person(kind, head, draw_looks(generator))
        result.append(Pictured(coefficients, (picture(who, 0, generator), picture(who, 1, generator))))
    return result


def picture(who: Person, view: int, generator: torch.Generator) -> Tensor:
    posed = closed_lids(who.kind, who.head, people_expression(generator))
    scene = surface(who.kind, who.head, posed, who.looks, generator)
    side = 1 if uniform(0, 1, generator) < 0.5 else -1
    yaw = side * uniform(28, 42, generator) if view else 6 * float(torch.randn((), generator=generator))
    angle = 2 * math.degrees(math.atan(110 / math.exp(uniform(math.log(400), math.log(2000), generator))))
    middle = posed[who.kind.landmarks][27:].double().mean(0)
    shown = render_person(who, scene, look_at(middle, yaw, 3.0, 260.0, SIZE, SIZE, angle), generator)
    wall = 0.6 * torch.rand(3, 1, 1, generator=generator)
    rgba = shown.image.permute(2, 0, 1)
    return (rgba[:3] * rgba[3:] + wall * (1 - rgba[3:])).clamp(0, 1)


def aligned(head: Tensor, goal: Tensor) -> Tensor:
    return similarity_transform(head[None].double(), goal[None].double()).apply(head[None].double())[0]


def normalised(fit: ImageFit, truth: Tensor) -> float:
    """The error of coefficients in the deviations that the fit states, 1 on average if they are right."""
    count = len(truth)
    covariance = fit.covariance[:count, :count].double()
    free = covariance.diagonal() > 0
    off = (fit.coefficients.double() - truth)[free]
    return float((off @ torch.linalg.solve(covariance[free][:, free], off) / free.sum()).sqrt())


def test_likeness_of_rendered_people(ict_folder: Path) -> None:
    torch.set_num_threads(1)
    whole = ict_head_model(ict_folder)
    face = region(whole.rig.neutral, "face")
    model, rig = whole.part(face), whole.rig.part(face)
    prior = load_priors(rig, DEFAULT_PRIOR, None).shapes
    modes = load_identity_modes(ict_folder).deltas[:, face]
    mean, faces, landmarks = model.shape.mean, rig.neutral.faces, rig.neutral.landmarks
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in [*WAYS, "mean head"]}
    heads, coefficients = [], model.shape.modes.double().flatten(1)
    known = torch.linalg.lstsq(coefficients.T, modes.double().flatten(1).T).solution
    stated: dict[str, list[float]] = {name: [] for name in WAYS}
    for who in people(ict_folder):
        found = [find_in_photographs([Path(f"{k}.png")], [one])[0] for k, one in enumerate(who.pictures)]
        sites = sites_on_rig(rig, found[0].places)
        truth = mean + torch.tensordot(who.coefficients, modes, dims=1)

        def points(vertices: Tensor, sites: Attachment = sites) -> Tensor:
            return torch.cat([vertices[landmarks], sites.on(faces, vertices)])

        def error(head: Tensor, truth: Tensor = truth) -> tuple[float, float]:
            pairs = ((head, truth), (points(head), points(truth)))
            region, spots = (float((aligned(a, b) - b.double()).norm(dim=1).mean()) for a, b in pairs)
            return region, spots

        for name, rows in WAYS.items():
            some = [found[row] for row in rows]
            settings = FitSettings(transfers=0, expression_prior=prior, annotated=True)
            marks = torch.stack([one.confident for one in some])
            read = with_readings(settings, FaceReading.stacked([one.face for one in some]), some[0].places, rig)
            fit = fit_images(model, rig, marks, (SIZE, SIZE), settings=read)
            errors[name].append(error(fit.mesh.vertices))
            stated[name].append(normalised(fit, known @ who.coefficients.double()))
            if len(rows) == 1:
                heads.append(aligned(points(fit.mesh.vertices), points(mean)).flatten())
        errors["mean head"].append(error(mean))
    apart = torch.cdist(torch.stack(heads), torch.stack(heads)).fill_diagonal_(torch.inf)
    owner = torch.arange(len(heads)) // 2
    nearest = int((owner[apart.argmin(1)] == owner).sum())
    medians = {name: torch.tensor(rows).median(0).values.tolist() for name, rows in errors.items()}
    print(f"\n{PEOPLE} people, two pictures each: {'face mm':>10s}{'points mm':>11s}")
    for name, (whole_face, spots) in medians.items():
        print(f"{name:34s}{whole_face:10.2f}{spots:11.2f}")
    deviations = {name: float(torch.tensor(rows).median()) for name, rows in stated.items()}
    print("errors of coefficients in stated deviations: " + ", ".join(f"{n} {v:.2f}" for n, v in deviations.items()))
    print(f"the nearest head is the same person's for {nearest} of {len(heads)}")
    assert medians["both"][1] < 0.75 * medians["mean head"][1]
    assert nearest > 0.2 * len(heads)
    assert all(0.7 < value < 1.4 for value in deviations.values())

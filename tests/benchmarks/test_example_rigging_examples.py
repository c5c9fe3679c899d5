"""Claim: eight examples bring a transferred rig much nearer to a person, on the examples and on unseen expressions.

Two kinds of people whose true shapes are known: performers made by code, whose shapes depend on who they are; and heads
of the ICT model with its own deltas, to which every shape adds an invented corrective: a smooth field that makes the
motion stronger here and weaker there, and two bumps along the normal where the shape moves most.

Errors are root mean squares over all vertices, the mean of the expressions, in millimetres. ``given`` is the error at
the true weights, ``solved`` at the weights that suit each rig best: what a solver would see of an unseen expression.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

from planted.asked_expressions import EXAMPLES
from torchface import BlendshapeRig, Mesh, load_take
from torchface.geometry.meshes.operators import vertex_normals
from torchface.io import load_ict_facekit, load_identity_modes
from torchface.modeling import ExampleRig, RiggingSchedule, rig_from_examples
from torchface.optim import box_qp
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.stages import perform

GUESSED = RiggingSchedule(gamma=(25.0, 25.0))


@dataclass(frozen=True)
class Case:
    """A template, a person whose shapes are known, and 20 expressions that no rig sees."""

    name: str
    template: BlendshapeRig
    person: BlendshapeRig
    unseen: Tensor


@dataclass(frozen=True)
class Measured:
    """Errors in millimetres: of the transferred rig on the examples (at true and at its best weights), of the personal
    rig on them, and of both rigs on unseen expressions, at the true weights and at the best of each rig."""

    made: ExampleRig
    transferred: tuple[float, float]
    personal: float
    given: tuple[float, ...]
    solved: tuple[float, ...]


def example_weights(names: tuple[str, ...]) -> Tensor:
    asked = torch.tensor([[0.9 * (name in line.split()) for name in ARKIT] for line in EXAMPLES])
    return asked @ mapping(ARKIT, names).T


def guesses(weights: Tensor, seed: int) -> Tensor:
    """Weights as a person guesses them: off by 0.1 where a shape is on, and one in twenty on that is not."""
    generator = torch.Generator().manual_seed(seed)
    noise = 0.1 * torch.randn(weights.shape, generator=generator)
    touched = (weights > 0) | (torch.rand(weights.shape, generator=generator) < 0.05)
    return (weights + noise * touched).clamp(0, 1)


def error(rig: BlendshapeRig, weights: Tensor, goals: Tensor) -> float:
    return float((rig(weights) - goals).square().sum(-1).mean(-1).sqrt().mean())


def best_weights(rig: BlendshapeRig, goals: Tensor) -> Tensor:
    shapes = rig.deltas.double().flatten(1)
    hessian = shapes @ shapes.T + 1e-3 * torch.eye(len(shapes), dtype=torch.float64)
    return box_qp(hessian, -(goals - rig.vertices).double().flatten(1) @ shapes.T).to(goals)


def with_correctives(rig: BlendshapeRig, head: Mesh, seed: int) -> BlendshapeRig:
    """The rig's deltas on another head, each with strengths that vary by 20 % and two bumps of 20 % of its motion."""
    generator = torch.Generator().manual_seed(seed)
    at, normals = head.vertices, vertex_normals(head.vertices, head.faces)
    deltas = []
    for delta in rig.deltas:
        size = delta.norm(dim=-1)
        centres = at[torch.randint(len(at), (6,), generator=generator)]
        strength = torch.exp(-torch.cdist(at, centres).square() / (2 * 35**2)) @ (
            0.2 * torch.randn(6, generator=generator)
        )
        strong = (size > 0.5 * size.max()).nonzero()[:, 0]
        peaks = at[strong[torch.randint(len(strong), (2,), generator=generator)]]
        height = 0.2 * float(size.max()) * torch.randn(2, generator=generator)
        bumps = torch.exp(-torch.cdist(at, peaks).square() / (2 * 9**2)) @ height
        deltas.append(delta * (1 + strength)[:, None] + (bumps * (size > 0.02))[:, None] * normals)
    return BlendshapeRig(head, torch.stack(deltas), rig.names)


def performer_cases() -> list[Case]:
    template = performer(texture=False)
    take = perform(2400, torch.Generator().manual_seed(5)).weights
    frames = template.weights_from(take).clamp(0, 1)
    unseen = frames[torch.linspace(60, len(frames) - 1, 20).long()]
    people = draw_identities(3, torch.Generator().manual_seed(0))
    return [
        Case(f"performer {i}", template, performer(identity, texture=False), unseen)
        for i, identity in enumerate(people)
    ]


def ict_cases(folder: Path, performances: list[Path]) -> list[Case]:
    template = load_ict_facekit(folder, part="face")
    modes = load_identity_modes(folder, part="face")
    frames = []
    for path in performances:
        track = load_take(path).weights
        frames.append(template.weights_from(track).clamp(0, 1))
    takes = torch.cat(frames)
    unseen = takes[torch.linspace(100, len(takes) - 100, 20).long()]
    return [
        Case(f"ICT head {seed}", template, with_correctives(template, modes.random_head(seed), seed), unseen)
        for seed in range(3)
    ]


def measure(case: Case, kind: str, given: Tensor, schedule: RiggingSchedule | None = None) -> Measured:
    truth = example_weights(case.template.names)
    examples, goals = case.person(truth), case.person(case.unseen)
    made = rig_from_examples(case.template, case.person.neutral, examples, given, schedule)
    rigs = (made.transferred, made.rig)
    found = Measured(
        made,
        (error(rigs[0], truth, examples), error(rigs[0], best_weights(rigs[0], examples), examples)),
        float(made.errors[-1].mean()),
        tuple(error(rig, case.unseen, goals) for rig in rigs),
        tuple(error(rig, best_weights(rig, goals), goals) for rig in rigs),
    )
    cells = [f"{found.transferred[0]:8.3f}{found.transferred[1]:8.3f}{found.personal:8.3f}"]
    cells += [f"{found.personal / found.transferred[0] - 1:6.0%}"]
    cells += [f"{before:8.3f}{after:8.3f}{after / before - 1:6.0%}" for before, after in (found.given, found.solved)]
    print(f"{case.name:12s} {kind:14s}{' '.join(cells)}{float(made.angles.max()):7.1f}", flush=True)
    return found


def table(cases: list[Case]) -> list[Measured]:
    print(
        f"\n{'':27s}{'examples: transfer':>16s}{'rig':>8s}{'':6s}{'unseen, given':>17s}{'':6s}{'unseen, solved':>17s}"
    )
    print(
        f"{'weights':>21s}{'':6s}{'given':>8s}{'solved':>8s}{'':15s}"
        + f"{'before':>8s}{'after':>8s}{'':7s}" * 2
        + "angle"
    )
    rows = []
    for number, case in enumerate(cases):
        truth = example_weights(case.template.names)
        rows.append(measure(case, "true", truth))
        measure(case, "guessed", guesses(truth, number))
        measure(case, "guessed, loose", guesses(truth, number), GUESSED)
    return rows


def hold(rows: list[Measured]) -> None:
    for row in rows:
        assert row.personal <= 0.4 * row.transferred[0]
        assert row.solved[1] <= 0.75 * row.solved[0]
        assert row.given[1] <= 0.8 * row.given[0]
        assert float(row.made.angles.max()) <= 30


def test_performers_made_by_code() -> None:
    hold(table(performer_cases()))


@pytest.mark.real
def test_real_rig_with_invented_correctives(ict_folder: Path, performances: list[Path]) -> None:
    hold(table(ict_cases(ict_folder, performances)))


MEASURED = """
import resource, sys, time
from pathlib import Path
import torch
from torchface.io.rigs.ict_facekit import load_ict_facekit, load_identity_modes
from torchface.modeling import rig_from_examples
folder = Path(sys.argv[1])
template = load_ict_facekit(folder, part="face")
head = load_identity_modes(folder, part="face").random_head(0)
generator = torch.Generator().manual_seed(0)
weights = torch.rand(8, len(template.names), generator=generator)
weights = weights * (torch.rand(weights.shape, generator=generator) < 0.15)
examples = head.vertices + 1.1 * (template(weights) - template.vertices)
start, worked = time.perf_counter(), time.process_time()
rig_from_examples(template, head, examples, weights)
wall, processor = time.perf_counter() - start, time.process_time() - worked
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(len(template.names), len(head.vertices), wall, processor, memory)
"""


@pytest.mark.real
def test_ten_rounds_within_a_minute_and_four_gigabytes(ict_folder: Path) -> None:
    # A process of its own: its peak of memory is not that of the tests before.
    done = subprocess.run([sys.executable, "-c", MEASURED, ict_folder], capture_output=True, text=True, check=True)
    shapes, vertices, wall, processor, memory = (float(number) for number in done.stdout.split())
    print(
        f"\n{shapes:.0f} shapes, {vertices:.0f} vertices, 8 examples, 10 rounds: {wall:.1f} s, "
        f"{processor:.1f} s of processor time, {memory:.2f} GB at most"
    )
    # What others do on the machine lengthens the wait, not the work.
    assert min(wall, processor) <= 60
    assert memory <= 4

"""Small instances of the classes that have tensors, each with inputs; the tests of modules go through them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

from planted.planted_correctives import planted_correctives
from torchface import Attachment, BlendshapeRig
from torchface.capture import (
    ActionUnitClassifier,
    DynamicsPrior,
    DynamicsSettings,
    ExampleSolver,
    HelmetSolver,
    HybridSolver,
    MarkerSolver,
    ShapePrior,
    VideoSolver,
    WebcamControls,
    WebcamSolver,
    WholeTakeSolver,
)
from torchface.capture.action_units import RegionGroup
from torchface.capture.action_units.classifier import GroupSize
from torchface.capture.anybody import ExampleShapes, LandmarkModel
from torchface.capture.own_rig import VideoSettings
from torchface.capture.priors import AdaptedDynamicsPrior, ReciprocalPrior
from torchface.enhancement import CapturedPerformance, EnhancementModel
from torchface.enhancement.wrinkle_maps.wrinkle_weights import WrinkleWeights
from torchface.geometry.meshes.operators import vertex_normals
from torchface.geometry.similarity import Similarity
from torchface.landmarks import (
    AppearanceModel,
    AppearanceSettings,
    BoxNetwork,
    DetectorSettings,
    EyeNetwork,
    LandmarkNetwork,
    LandmarkTrees,
    UVLandmarkDetector,
)
from torchface.landmarks.images.networks.part_network import PartNetwork
from torchface.landmarks.scans.hog import HogLayout
from torchface.modeling import ExpressionRegression, ExpressionSettings, HeadModel, MorphableModel
from torchface.onnx import SolverGraph
from torchface.optim import BoxQP, FixedSplitting, ProjectedGradient
from torchface.synthetic import performer

SOLVER = {"vmap": "batches", "jacrev": "jacobian", "torch.compile": "gap"}
SOLVER_GRAPH, CORRECTIVE_GRAPH, NOT_EXPORTED, TO_ONNX = (
    {**SOLVER, "torch.export": cell} for cell in ("SolverGraph", "CorrectiveGraph", "no", "ONNX")
)
NAMES = ("jawOpen", "mouthPucker", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "eyeBlinkLeft")
CAMERA = torch.tensor([[700.0, 0, 319.5], [0, 700.0, 239.5], [0, 0, 1]], dtype=torch.float64)


@dataclass(frozen=True)
class Example:
    """A class of modules."""

    make: Callable[[int], Any]  # an instance; of 0 and 1 two that differ in nothing but their state
    inputs: Callable[[], tuple[Tensor, ...]]  # that both take
    # what is computed of the inputs, where it is not `module(*inputs)`
    call: Callable[..., Any] = lambda module, *inputs: module(*inputs)
    cells: Mapping[str, str] = field(default_factory=dict)  # of the table, by column, where they are not `yes`


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@cache
def rig(number: int = 0) -> BlendshapeRig:
    """The performer with few shapes; 1 is a larger head whose shapes go less far."""
    whole = performer(texture=False).select(NAMES)
    if not number:
        return whole
    return BlendshapeRig(whole.neutral.with_vertices(1.1 * whole.vertices), 0.7 * whole.deltas, NAMES)


@cache
def corrected_rig(number: int = 0) -> BlendshapeRig:
    plain = rig(number)
    return BlendshapeRig(plain.neutral, plain.deltas, NAMES, planted_correctives(rig(), 3))


@cache
def sites() -> Attachment:
    whole = rig()
    moved = (whole.deltas.norm(dim=-1).amax(0) > 1).nonzero()[:, 0]
    return Attachment.from_vertices(whole.neutral, moved[:: len(moved) // 30][:30])


@cache
def takes(number: int = 0) -> list[Tensor]:
    time = torch.linspace(0, 9, 80, dtype=torch.float64)[:, None]
    phases = torch.arange(len(NAMES)) + 3 * number
    return [((time + phase * phases).sin().clamp(min=0) ** 2) * (1 - 0.4 * number) for phase in (1.0, 1.7)]


@cache
def shape_prior(number: int) -> ShapePrior:
    return ShapePrior.fit(takes(number), NAMES)


@cache
def reciprocal_prior(number: int) -> ReciprocalPrior:
    centres = torch.cat(takes(number))[::16]
    learned = ReciprocalPrior.from_config({
        "names": list(NAMES), "groups": [list(range(len(NAMES)))], "strength": 1.0,
        "densities": [{"kind": "parzen", "centers": len(centres), "dimensions": len(NAMES)}],
    })  # fmt: skip
    learned.densities[0].centers.copy_(centres)
    return learned


@cache
def dynamics_prior(number: int) -> DynamicsPrior:
    quick = DynamicsSettings(inducing=8, subset=60, iterations=2)
    return DynamicsPrior.fit(takes(number), NAMES, window=3, settings=quick)


def marker_solver(number: int) -> MarkerSolver:
    space = Similarity(torch.tensor([1.05]), torch.eye(3)[None], torch.tensor([[10.0, 5 - 9 * number, 0]]))
    return MarkerSolver(rig(number), sites(), space, sparsity=torch.tensor(0.01 + 0.02 * number))


def corrected_solver(number: int) -> MarkerSolver:
    return MarkerSolver(corrected_rig(number), sites())


def seen_markers(whole: BlendshapeRig) -> Tensor:
    """Markers (4,M,3), millimetres; the last two frames lack some."""
    seen = sites().on(whole.neutral.faces, whole(0.6 * random(4, len(NAMES)).float())).detach().clone()
    seen[2:, 3] = torch.nan
    return seen.double()


def video_solver(number: int) -> VideoSolver:
    camera = torch.diag(torch.tensor([1 + 0.1 * number, 1 + 0.1 * number, 1], dtype=torch.float64)) @ CAMERA
    settings = VideoSettings(relative_noise=0.01)
    return VideoSolver(rig(number), None, camera, shape_prior(number), dynamics_prior(number), settings)


@cache
def seen_landmarks() -> Tensor:
    """Landmarks (3,68,2), pixels."""
    whole = rig()
    points = whole(0.6 * random(3, len(NAMES)).float())[:, whole.neutral.landmarks].double()
    placed = points * torch.tensor([1.0, -1, -1]).double() + torch.tensor([0.0, 0, 500]).double()
    image = placed @ CAMERA.T
    return image[..., :2] / image[..., 2:]


def webcam_solver(number: int) -> WebcamSolver:
    modes = random(4, 68, 3, seed=number).float()
    return WebcamSolver(rig(number), modes, shape_prior(number))


def webcam_inputs() -> tuple[Tensor, ...]:
    pixels = seen_landmarks()[0].float()
    sure, both = torch.ones(68), torch.ones(2)
    return (
        pixels, sure, sure, both[0], pixels[[36, 42]], 0.3 * both, 0 * both, both, torch.full((52,), torch.nan),
        torch.full((52,), torch.inf), torch.tensor([640.0, 480.0]), torch.tensor(1 / 30), WebcamControls().tensor(),
        webcam_solver(0).start().pack(),
    )  # fmt: skip


@cache
def example_shapes(number: int) -> ExampleShapes:
    neutral = seen_landmarks()[0].float() * (1 + 0.1 * number)
    moved = neutral + 12 * (random(5, 68, 2, seed=number).float() - 0.5)
    return ExampleShapes(NAMES[:5], neutral, moved)


def projecting_example_solver(number: int) -> ExampleSolver:
    return ExampleSolver(example_shapes(number), LandmarkModel.fit(example_shapes(number)))


def morphable_model(number: int) -> MorphableModel:
    return MorphableModel.fit(random(5, 30, 3, seed=number).float())


def head_model(number: int) -> HeadModel:
    whole = rig(number)
    people = whole(0.6 * random(4, len(NAMES), seed=number).float())
    shape, color = MorphableModel.fit(people), MorphableModel.fit(random(4, *people.shape[1:], seed=number).float())
    return HeadModel.on(whole.neutral, shape, color, whole)


@cache
def expression_regression(number: int) -> ExpressionRegression:
    whole = rig(number)
    neutrals = whole(0.3 * random(6, len(NAMES), seed=number).float())
    sizes = 1 + 0.2 * random(6, 1, 1, 1, seed=number).float()
    expressions = neutrals[:, None] + sizes * whole.deltas[:2]
    return ExpressionRegression.fit(neutrals, expressions, ExpressionSettings(3, 3), NAMES[:2])


@cache
def enhancement_model(number: int) -> EnhancementModel:
    whole = rig(number)
    course = torch.linspace(0, torch.pi, 6).sin()
    extremes = torch.tensor([[1.0, 0, 0.5, 0, 0, 0], [0, 1, 0, 0.6, 0, 0.5], [0, 0, 0.4, 1, 0.8, 0]])
    smooth = whole((course[None, :, None] * extremes[:, None]).flatten(0, 1))
    neutral, faces = whole.vertices, whole.neutral.faces
    waves = 0.1 * ((2.1 - number) * neutral[:, 1]).sin() * (smooth - neutral).norm(dim=-1)
    frames = smooth + waves[..., None] * vertex_normals(smooth, faces)
    performance = CapturedPerformance(frames, faces, torch.arange(3).repeat_interleave(6), neutral)
    return EnhancementModel.fit(performance, rank=6, patch_size=60, region_count=3)


@cache
def wrinkle_weights(number: int) -> WrinkleWeights:
    whole, weights = rig(number), random(20, len(NAMES), seed=number).float()
    maps = (weights[:, None, :2] * weights[:, None, 2:4]).repeat(1, 2, 1)
    halves = (whole.vertices[:, 1] > 0).float()
    shares = torch.stack([halves, 1 - halves])
    return WrinkleWeights.fit(whole.vertices, whole(weights), maps, shares, ["upper", "lower"])


def landmark_trees(number: int) -> LandmarkTrees:
    trees = LandmarkTrees(landmarks=5, cascades=2, trees=3, depth=2, features=6, components=4)
    drawn = torch.Generator().manual_seed(number)
    for name, limit in (("anchors", 5), ("first", 6), ("second", 6), ("leaves", 100)):
        buffer = getattr(trees, name)
        buffer.copy_(torch.randint(limit, buffer.shape, generator=drawn))
    for name in ("mean", "offsets", "thresholds", "scales", "bases"):
        getattr(trees, name).uniform_(generator=drawn)
    return trees


def faces_in_pictures(number: int) -> tuple[Tensor, Tensor]:
    """Pictures (4,1,72,72) of one pattern, moved, and landmarks (4,68,2) that move with it, pixels."""
    coarse = random(1, 1, 12, 12, seed=number)
    pattern = torch.nn.functional.interpolate(coarse, size=(72, 72), mode="bicubic").clamp(0, 1).float()
    points = seen_landmarks()[:1].float()
    points = 10 + 50 * (points - points.amin(1)) / (points.amax(1) - points.amin(1)).max()
    images = torch.cat([pattern.roll((step, step), (2, 3)) for step in range(4)])
    return images, points + torch.arange(4.0)[:, None, None] + random(4, 68, 2, seed=7).float()


@cache
def appearance_model(number: int) -> AppearanceModel:
    images, landmarks = faces_in_pictures(number)
    return AppearanceModel.fit(list(images), landmarks, AppearanceSettings("grey", (8.0, 12.0), iterations=2))


def appearance_inputs() -> tuple[Tensor, Tensor]:
    images, landmarks = faces_in_pictures(0)
    return images[:2], landmarks[:2] + 1.5


@cache
def uv_detector(number: int) -> UVLandmarkDetector:
    settings = DetectorSettings(hog=HogLayout(stride=4), responses=20)
    places = torch.tensor([[30.0, 32.0], [64.0, 60.0]]) + 4 * random(3, 2, 2, seed=number).float()
    return UVLandmarkDetector.fit(random(3, 1, 96, 96, seed=number).float(), places, ("a", "b"), settings=settings)


def action_unit_classifier(number: int) -> ActionUnitClassifier:
    groups = [RegionGroup("brows", ("left brow", "right brow"), ("1", "4"), ())]
    model = ActionUnitClassifier(groups, [GroupSize(3, 3)], 16)
    for seed, buffer in enumerate(model.buffers()):
        if not bool(buffer.any()):
            buffer.copy_(random(*buffer.shape, seed=10 * number + seed) - 0.3)
    return model


def network(kind: Callable[[], nn.Module]) -> Callable[[int], nn.Module]:
    def make(number: int) -> nn.Module:
        with torch.random.fork_rng():
            torch.manual_seed(number)
            made = kind()
            for parameter in made.parameters():
                if not bool(parameter.any()):
                    torch.nn.init.normal_(parameter, std=0.1)
            return made.eval()

    return make


def box_qp(number: int) -> BoxQP:
    A = random(12, 6, seed=number).float()
    return BoxQP(A.T @ A)  # as symmetric as rounding leaves it


def prior_energy(prior: ShapePrior, weights: Tensor) -> tuple[Tensor, ...]:
    energy = prior.energy(weights)
    return prior.log_density(weights), energy.H, energy.f


def pulled_markers() -> tuple[Tensor, ...]:
    return seen_markers(rig()), random(4, len(NAMES), seed=5), 2 * random(4, len(NAMES), seed=6)


def graph_inputs() -> tuple[Tensor, ...]:
    return seen_markers(rig()).float(), random(4, len(NAMES), seed=7).float()


def solver_graph(number: int) -> SolverGraph:
    solver = marker_solver(number)
    return SolverGraph(solver, FixedSplitting(solver.complete_hessian(), steps=3), FixedSplitting(steps=3))


def helmet(solver: HelmetSolver, markers: Tensor) -> tuple[Tensor, ...]:
    weights, motion = solver(markers)
    return weights, motion.rotation, motion.translation


EXAMPLES: dict[str, Example] = {
    "BoxQP": Example(
        box_qp, lambda: (random(10, 6, seed=3).float() - 1,), cells={"torch.compile": "gap", "torch.export": "no"}
    ),
    "ProjectedGradient": Example(
        lambda n: ProjectedGradient(box_qp(n).H, steps=60), lambda: (random(10, 6, seed=3).float() - 1,)
    ),
    "MarkerSolver": Example(marker_solver, lambda: (seen_markers(rig()),), cells=SOLVER_GRAPH),
    "MarkerSolver with correctives": Example(
        corrected_solver, lambda: (seen_markers(corrected_rig()),), cells=CORRECTIVE_GRAPH
    ),
    "HelmetSolver": Example(
        lambda n: HelmetSolver(rig(n), sites()), lambda: (seen_markers(rig()),), helmet, NOT_EXPORTED
    ),
    "HybridSolver": Example(lambda n: HybridSolver(marker_solver(n)), pulled_markers, cells=SOLVER_GRAPH),
    "HybridSolver with correctives": Example(
        lambda n: HybridSolver(corrected_solver(n)), pulled_markers, cells=CORRECTIVE_GRAPH
    ),
    "WholeTakeSolver": Example(
        lambda n: WholeTakeSolver(marker_solver(n)), lambda: (seen_markers(rig()),),
        cells={**NOT_EXPORTED, "gradients": "no", "jacrev": "no"},
    ),
    "VideoSolver": Example(
        video_solver, lambda: (seen_landmarks(),), lambda m, x: list(vars(m(x)).values()),
        {**SOLVER, "torch.export": "VideoGraph"},
    ),
    "WebcamSolver": Example(webcam_solver, webcam_inputs, cells={"gradients": "no", "vmap": "no", "jacrev": "no"}),
    "ExampleSolver": Example(
        lambda n: ExampleSolver(example_shapes(n)), lambda: (seen_landmarks(),), cells=TO_ONNX
    ),
    "ExampleSolver with LandmarkModel": Example(projecting_example_solver, lambda: (seen_landmarks(),), cells=TO_ONNX),
    "FixedSplitting": Example(
        lambda n: FixedSplitting(random(12, 6, seed=n).T @ random(12, 6, seed=n), steps=3),
        lambda: (random(10, 6, seed=3) - 1,),
    ),
    "SolverGraph": Example(solver_graph, graph_inputs, cells={"vmap": "no"}),
    "SolverGraph with predictions": Example(
        solver_graph, lambda: (*graph_inputs(), *(x.float() for x in pulled_markers()[1:])), cells={"vmap": "no"}
    ),
    "BlendshapeRig": Example(corrected_rig, lambda: (random(3, len(NAMES)).float(),)),
    "ShapePrior": Example(shape_prior, lambda: (random(3, len(NAMES)),), prior_energy),
    "ReciprocalPrior": Example(reciprocal_prior, lambda: (random(3, len(NAMES)),), prior_energy),
    "DynamicsPrior": Example(dynamics_prior, lambda: (random(3, 3, len(NAMES)).float(),)),
    "AdaptedDynamicsPrior": Example(
        lambda n: AdaptedDynamicsPrior(dynamics_prior(n), NAMES[::-1], 45.0),
        lambda: (random(3, 4, len(NAMES)).float(),),
    ),
    "MorphableModel": Example(morphable_model, lambda: (random(3, 4).float(),)),
    "HeadModel": Example(head_model, lambda: (random(3, 3).float(), random(3, 3).float())),
    "ExpressionRegression": Example(expression_regression, lambda: (rig().vertices[None],), cells={"vmap": "no"}),
    "EnhancementModel": Example(
        enhancement_model, lambda: (rig()(0.5 * random(2, len(NAMES)).float()),), cells=NOT_EXPORTED
    ),
    "WrinkleWeights": Example(wrinkle_weights, lambda: (rig()(0.5 * random(2, len(NAMES)).float()),)),
    "ActionUnitClassifier": Example(
        action_unit_classifier, lambda: (random(3, 2, 16, 16).float(), random(2, 16, 16, seed=1).float()),
        cells={"gradients": "no", "jacrev": "no"},
    ),
    "LandmarkTrees": Example(
        landmark_trees, lambda: (random(2, 1, 40, 40).float(), torch.tensor([[5.0, 5, 30, 30], [8, 6, 25, 28]])),
        cells={"gradients": "no", "jacrev": "no"},
    ),
    "AppearanceModel": Example(appearance_model, appearance_inputs, cells=NOT_EXPORTED),
    "UVLandmarkDetector": Example(
        uv_detector, lambda: (random(2, 1, 96, 96, seed=1).float(),),
        cells={**NOT_EXPORTED, "gradients": "no", "jacrev": "no"},
    ),
    "LandmarkNetwork": Example(
        network(lambda: LandmarkNetwork(32, channels=(4, 4, 6, 8), blocks=(1, 1, 1), decoder=6, points=5, hidden=12)),
        lambda: (random(2, 3, 32, 32).float(),),
    ),
    "BoxNetwork": Example(
        network(lambda: BoxNetwork((4, 4, 6, 8), (1, 1, 1, 1), 4)), lambda: (random(2, 3, 64, 64).float(),)
    ),
    "EyeNetwork": Example(
        network(lambda: EyeNetwork(16, 16, (4, 4, 4), (1, 1, 1), 6)), lambda: (random(2, 3, 16, 16).float(),)
    ),
    "PartNetwork": Example(
        network(lambda: PartNetwork((4, 4, 4, 4), (1, 1, 1, 1))), lambda: (random(2, 3, 16, 32).float(),)
    ),
}  # fmt: skip
"""By name, as the table has them."""

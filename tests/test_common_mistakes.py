"""What users pass by mistake ends in a clear error; NumPy's arrays and lists are taken where that is safe."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import torchface
from torchface import Annotations, Attachment, BlendshapeRig, Mesh, Take, Track
from torchface.capture import (
    DynamicsPrior,
    ExampleSolver,
    HelmetSolver,
    HybridSolver,
    MarkerSolver,
    ShapePrior,
    WebcamSolver,
    WholeTakeSolver,
    align_take,
    fit_attachment,
)
from torchface.capture.own_rig import VideoSolver
from torchface.correctives import Corrective, Correctives
from torchface.enhancement import CapturedPerformance, EnhancementModel
from torchface.errors import ArgumentTypeError, TorchfaceError
from torchface.landmarks import find_faces
from torchface.modeling import (
    ExpressionRegression,
    ExpressionSettings,
    HeadModel,
    MorphableModel,
    RiggingSchedule,
    align_scan,
    bake_normal_map,
    corrective_from_sculpt,
    detail_maps,
    inner_parts,
    neutral_notes,
    open_eyes,
    rig_from_examples,
    rig_from_neutral,
    shapes_on,
    transfer_deformation,
)
from torchface.onnx import export_module
from torchface.optim import BoxQP, ProjectedGradient, box_qp, simplex_qp
from torchface.registration import register


class Given:
    """A small rig with markers and models, whole."""

    def __init__(self, rig: BlendshapeRig) -> None:
        self.rig, self.mesh = rig, rig.neutral
        self.v, self.f, self.d = rig.vertices, rig.neutral.faces, rig.deltas
        self.sites = Attachment.from_vertices(self.mesh, range(0, 600, 9))
        self.solver = MarkerSolver(rig, self.sites)
        self.markers = self.sites.on(self.f, rig(torch.zeros(3, len(rig.names))))
        self.take = Take(30.0, markers=Track(self.sites.labels, self.markers))
        self.heads = self.v + torch.randn(4, *self.v.shape, generator=torch.Generator().manual_seed(0))
        self.model = MorphableModel.fit(self.heads)
        self.regression = ExpressionRegression.fit(self.heads, self.heads[:, None] + self.d[:1], names=["jawOpen"])
        weights = torch.rand(60, len(rig.names), generator=torch.Generator().manual_seed(0))
        self.prior = ShapePrior.fit([weights], rig.names)
        self.H, self.q = 2 * torch.eye(3).double(), -torch.ones(4, 3).double()


@pytest.fixture(scope="module")
def given(dome_rig: BlendshapeRig) -> Given:
    return Given(dome_rig)


MISTAKES: dict[str, tuple[Callable[[Given], Any], str]] = {
    "a path for vertices": (lambda g: Mesh("head.obj", g.f), r"vertices: found the text 'head.obj', expected a tensor"),
    "no faces": (lambda g: Mesh(g.v, None), r"faces: found None, expected a tensor \(F,3\)"),
    "faces of floats": (lambda g: Mesh(g.v, g.f.float()), "faces: found torch.float32, expected torch.int64"),
    "faces of a list of floats": (lambda g: Mesh(g.v, [[0.5, 1, 2]]), "faces: found floats, expected whole numbers"),
    "points of two numbers": (lambda g: Mesh(g.v[:, :2], g.f), r"vertices: found \(\d+, 2\), expected"),
    "a tensor for a neutral": (lambda g: BlendshapeRig(g.v, g.d, g.rig.names), "neutral: found a tensor .* a Mesh"),
    "a path for a neutral": (lambda g: BlendshapeRig("a.glb", g.d, "x"), "neutral: .*torchface.load_mesh reads one"),
    "a region for a part": (
        lambda g: g.rig.part("face"),
        r"keep: found the text 'face', .*annotations.regions\['face'\]",
    ),
    "one name as a text": (lambda g: BlendshapeRig(g.mesh, g.d[:1], "jawOpen"), r"expected a list of names: \['jaw"),
    "too few names": (lambda g: BlendshapeRig(g.mesh, g.d, ["a"]), "found 1 names for 4 deltas"),
    "weights by name": (lambda g: g.rig({"jawOpen": 1.0}), r"weights: found a dict, expected a tensor \(B,4\)"),
    "a row of weights": (lambda g: g.rig(torch.zeros(4)), r"weights: found \(4,\), expected \(B,4\)"),
    "too many weights": (lambda g: g.rig(torch.zeros(2, 9)), r"weights: found \(2, 9\), expected \(B,4\)"),
    "correctives for names": (lambda g: BlendshapeRig(g.mesh, g.d, g.rig.names, g.d), "correctives: found a tensor"),
    "definitions first": (
        lambda g: Correctives((Corrective("c", g.rig.names[:2]),), g.d[:1]),
        "correctives: deltas: found a tuple of Corrective, expected a tensor",
    ),
    "one definition": (lambda g: Correctives(g.d[:1], Corrective("c", g.rig.names[:2])), "expected a list of Corr"),
    "names for definitions": (lambda g: Correctives(g.d[:1], ["c"]), "definition: found the text 'c', expected a C"),
    "sites the wrong way": (lambda g: Attachment(g.sites.barycentric, g.sites.triangles), "triangles: found torch.flo"),
    "a rig for a mesh": (
        lambda g: Attachment.from_vertices(g.rig, [1, 2]),
        "mesh: found a BlendshapeRig, expected a M",
    ),
    "vertices between vertices": (
        lambda g: Attachment.from_vertices(g.mesh, [1.5]),
        "ids: found floats, expected whol",
    ),
    "a track of a text": (lambda g: Track("ab", torch.zeros(4, 2, 3)), "names: found the text 'ab', expected a list"),
    "a flat track": (lambda g: Track(("a", "b"), torch.zeros(4, 2)), r"values \(4, 2\), expected \(T,2,D\)"),
    "a tensor for a track": (lambda g: Take(30.0, markers=g.markers), "take: markers: found a tensor .* a Track"),
    "a rate as a text": (lambda g: Take("30", markers=None), "take: found 30 frames a second, expected"),
    "a mesh for a rig": (lambda g: MarkerSolver(g.mesh, g.sites), "rig: found a Mesh, expected a BlendshapeRig"),
    "a path for a rig": (lambda g: MarkerSolver("a.glb", g.sites), "torchface.load_rig reads one from a file"),
    "ids for sites": (lambda g: MarkerSolver(g.rig, [1, 2]), "attachment: found a list of int, expected an Attach"),
    "sites before the rig": (lambda g: MarkerSolver(g.sites, g.rig), "rig: found an Attachment, expected a Blend"),
    "a take for markers": (lambda g: g.solver(g.take), r"markers: found a Take, expected a tensor \(B,67,3\)"),
    "one frame of markers": (lambda g: g.solver(g.markers[0]), r"markers: found \(67, 3\), expected \(B,67,3\)"),
    "too few markers": (lambda g: g.solver(g.markers[:, :5]), r"markers: found \(3, 5, 3\), expected"),
    "markers for a take": (lambda g: g.solver.solve_take(g.markers), "take: found a tensor .* expected a Take"),
    "markers to align": (lambda g: align_take(g.rig, g.sites, g.markers), "take: found a tensor .* expected a Take"),
    "ids to fit": (lambda g: fit_attachment(g.rig, g.take, [1]), "initial: found a list of int, expected an Att"),
    "one row of f": (lambda g: box_qp(g.H, g.q[0]), r"found f \(3,\), expected \(B,3\) for H \(3, 3\)"),
    "f before H": (lambda g: box_qp(g.q, g.H), r"found H \(4, 3\), expected \(N,N\)"),
    "two precisions": (lambda g: box_qp(g.H, g.q.float()), "f of torch.float32 and H of torch.float64, expected the"),
    "rows of other lengths": (lambda g: box_qp([[1.0], [1.0, 2.0]], g.q), "H: found a list of list, expected a tensor"),
    "a text for H": (lambda g: BoxQP("H"), "H: found the text 'H', expected a tensor"),
    "no H": (lambda g: ProjectedGradient()(g.q), "found no H, expected one here or where the module is made"),
    "a simplex of other size": (lambda g: simplex_qp(g.H, g.q[:, :2]), r"f \(4, 2\) for H \(3, 3\), expected \(B,3\)"),
    "meshes for samples": (lambda g: MorphableModel.fit([g.mesh] * 3), "samples: found a list of Mesh, expected a te"),
    "flat samples": (lambda g: MorphableModel.fit(g.heads[..., 0]), r"samples: found \(4, \d+\), expected floats"),
    "samples for a model": (lambda g: HeadModel(g.heads, None, g.f), "shape: found a tensor .* a MorphableModel"),
    "too many coefficients": (lambda g: g.model(torch.zeros(1, 9)), r"coefficients: found \(1, 9\), expected \(B,3\)"),
    "two and a half components": (
        lambda g: MorphableModel.fit(g.heads, 2.5),
        "components of 4 samples: found 2.5, exp",
    ),
    "a count of floats": (lambda g: g.model.truncate(2.0), r"count: found 2\.0, expected a whole number fr"),
    "a share as a text": (lambda g: g.model.truncate(variance="0.9"), "variance: found '0.9', expected a finite numb"),
    "vertices by floats": (
        lambda g: g.model.project(g.heads[:, :2], vertices=[0.0, 1.0]),
        "vertices: found floats, expected whole numbers",
    ),
    "a mask of another head": (lambda g: g.model.part([True] * 4), r"vertices: found \(4,\), expected ids \(N,\) or a"),
    "pairs of ids": (lambda g: g.model.project(g.heads[:, :4], [[0, 1], [2, 3]]), r"vertices: found \(2, 2\), exp"),
    "a vertex of another head": (lambda g: g.model.part([0, 999]), "vertices: found indices 0 to 999, expected 0 to"),
    "samples by the half": (lambda g: g.model.sample(1.5), "count: found 1.5, expected a whole number"),
    "steps by the half": (lambda g: g.model.interpolate([0.0] * 3, [1.0] * 3, 2.5), "steps: found 2.5, expected a wh"),
    "vertices for pairs": (
        lambda g: align_scan(g.mesh, g.mesh, (["chin"], g.v[:1])),
        "correspondences: found a list of str, expected a tensor",
    ),
    "a mesh for neutrals": (lambda g: g.regression(g.mesh), r"neutrals: found a Mesh, expected a tensor"),
    "one neutral": (lambda g: g.regression(g.v), r"neutrals: found \(\d+, 3\), expected \(B,\d+,3\)"),
    "a face for a rig": (lambda g: transfer_deformation(g.mesh, g.rig), "source: found a Mesh, expected a Blendshape"),
    "vertices for a face": (lambda g: transfer_deformation(g.rig, g.v), "target: found a tensor .* expected a Mesh"),
    "a template first": (
        lambda g: rig_from_neutral(g.rig, g.regression, g.mesh),
        "regression: found a BlendshapeRig, expected an ExpressionRegression",
    ),
    "paths to register": (lambda g: register("a.obj", "b.obj"), "template: found the text 'a.obj', expected a Mesh"),
    "no path": (lambda g: torchface.load_rig(None), "path: found None, expected a path"),
    "a mesh for a path": (lambda g: torchface.load_mesh(g.mesh), "path: found a Mesh, expected a path"),
    "a path before the rig": (lambda g: torchface.save_rig("a.glb", g.rig), "rig: found the text 'a.glb', expected"),
    "vertices to save": (lambda g: torchface.save_mesh(g.v, "a.obj"), "mesh: found a tensor .* expected a Mesh"),
    "weights to save": (lambda g: torchface.save_animation(g.rig, g.q, "a.glb"), "take: found a tensor .* a Take"),
    "a slope as a start": (lambda g: BoxQP(g.H)(g.q, "0"), r"start: found the text '0', expected a tensor \(B,N\)"),
    "a bound as a text": (lambda g: box_qp(g.H, g.q, "0"), r"lower: found the text '0', expected a tensor \(N,\)"),
    "a name for a program": (lambda g: MarkerSolver(g.rig, g.sites, program="gradient"), "program: .*a ProjectedGrad"),
    "a class for a program": (
        lambda g: MarkerSolver(g.rig, g.sites, program=ProjectedGradient),
        "program: found the class ProjectedGradient, expected a ProjectedGradient",
    ),
    "a rig for a hybrid solver": (lambda g: HybridSolver(g.rig), "markers: found a BlendshapeRig, expected a MarkerS"),
    "a path for a helmet's markers": (
        lambda g: HelmetSolver(g.rig, g.sites)("a.c3d"),
        "markers: found the text 'a.c3d'",
    ),
    "no prediction": (
        lambda g: HybridSolver(g.solver)(g.markers, None, g.q),
        "predicted: found None, expected a tensor",
    ),
    "a text for a take's markers": (lambda g: WholeTakeSolver(g.solver)("a"), "markers: found the text 'a', expected"),
    "a text for weights": (lambda g: g.prior.energy("jawOpen"), "weights: found the text 'jawOpen', expected a tensor"),
    "a weight as a text": (lambda g: transfer_deformation(g.rig, g.mesh, "30"), "contact_weight: found '30', expected"),
    "settings as a dict": (
        lambda g: ExpressionRegression.fit(g.heads, g.heads[:, None], {"ridge": 0.1}),
        "settings: found a dict, expected an ExpressionSettings",
    ),
    "a form that is none": (lambda g: ExpressionSettings(form="poses"), "form: found 'poses', expected one of offsets"),
    "a batch of weights": (
        lambda g: corrective_from_sculpt(g.rig, [[1.0, 1, 0, 0]], g.v),
        r"weights: found \(1, 4\), expected \(4,\)",
    ),
    "a sculpt of another head": (
        lambda g: corrective_from_sculpt(g.rig, [1.0, 1, 0, 0], g.v[:-1]),
        r"sculpt: found \(624, 3\), expected \(625, 3\)",
    ),
    "one number for two": (lambda g: RiggingSchedule(beta=0.5), "beta: found 0.5, expected two numbers"),
    "a schedule as a number": (
        lambda g: rig_from_examples(g.rig, g.mesh, g.heads[:1], torch.eye(4)[:1], 5),
        "schedule: found an int, expected a RiggingSchedule",
    ),
    "an alignment as a text": (
        lambda g: bake_normal_map(g.mesh, g.mesh, 8, alignment="x"),
        "alignment: found the text",
    ),
    "settings as a number": (lambda g: bake_normal_map(g.mesh, g.mesh, 8, settings=3), "settings: found an int, exp"),
    "meshes for maps": (lambda g: detail_maps(["a"], [g.mesh]), "a map: found a Mesh, expected a NormalMap"),
    "a mesh with open eyes": (lambda g: open_eyes(g.mesh, g.mesh), "template: found a Mesh, expected a BlendshapeRig"),
    "parts of a mesh": (lambda g: inner_parts(g.mesh), "template: found a Mesh, expected a BlendshapeRig"),
    "notes on a rig": (lambda g: neutral_notes(g.rig, g.rig), "head: found a BlendshapeRig, expected a Mesh"),
    "shapes of a mesh": (lambda g: shapes_on(g.mesh, g.mesh), "template: found a Mesh, expected a BlendshapeRig"),
    "a mesh for a take's solver": (lambda g: WholeTakeSolver(g.mesh), "markers: found a Mesh, expected a MarkerSolv"),
    "a path for a webcam": (lambda g: WebcamSolver("a.glb"), "rig: found the text 'a.glb', .*torchface.load_rig reads"),
    "markers for examples": (lambda g: ExampleSolver(g.markers), "examples: found a tensor .* an ExampleShapes"),
    "a prior for landmarks": (
        lambda g: VideoSolver(g.rig, g.prior, torch.eye(3)),
        "landmark_vertices: found a ShapePrior, expec",
    ),
    "a text for landmarks' weights": (
        lambda g: VideoSolver(g.rig, [*range(68)], torch.eye(3), landmark_weights="even"),
        "landmark_weights: found the text 'even', expected a tensor",
    ),
    "a focal length alone": (lambda g: VideoSolver(g.rig, g.f[:68, 0], 500.0), "intrinsics: found a float, expected"),
    "weights as a tensor": (lambda g: g.rig.weights_from(g.q), r"track: found a tensor \(4, 3\), expected a Track"),
    "a mesh for vertices": (lambda g: g.mesh.with_vertices(g.mesh), "vertices: found a Mesh, expected a tensor"),
    "landmarks as a text": (lambda g: Annotations("ibug"), r"landmarks: found the text 'ibug', expected a tensor"),
    "names before takes": (
        lambda g: ShapePrior.fit(g.rig.names, torch.zeros(9, 4)),
        "names: a name: found a tensor .* expected a str",
    ),
    "motion by names": (lambda g: DynamicsPrior.fit(g.rig.names, [g.q]), "names: a name: found a tensor"),
    "frames for a performance": (lambda g: EnhancementModel.fit(g.heads), "performance: found a tensor .* a Captured"),
    "meshes for frames": (lambda g: CapturedPerformance([g.mesh], g.f, [0], g.v), "frames: found a list of Mesh"),
    "vertices for a scan": (lambda g: align_scan(g.mesh, g.v), "scan: found a tensor .* expected a Mesh"),
    "vertices to bake": (lambda g: bake_normal_map(g.v, g.mesh), "mesh: found a tensor .* expected a Mesh"),
    "a sculpt by name": (
        lambda g: corrective_from_sculpt(g.rig, {"jawOpen": 1.0}, g.v),
        r"weights: found a dict, expected a tensor \(N,\)",
    ),
    "a path for a picture": (lambda g: find_faces("a.png"), "image: found the text 'a.png', expected a tensor"),
    "inputs without names": (lambda g: export_module(g.solver, [g.markers], "a.onnx"), "inputs: found a list of Tens"),
    "a path for a module": (lambda g: export_module("a", {"x": g.q}, "a.onnx"), "module: found the text 'a', expected"),
    "a class before its kind": (lambda g: torchface.zoo.register(MarkerSolver, "x"), "kind: found the class MarkerSo"),
    "a track to save": (lambda g: torchface.save_take(g.take.markers, "a.csv"), "take: found a Track, expected a Take"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_in_an_error_that_names_the_argument(mistake: str, given: Given) -> None:
    call, said = MISTAKES[mistake]
    with pytest.raises(TorchfaceError, match=said):
        call(given)


def test_landmarks_of_one_frame_are_not_taken_for_68_frames(given: Given) -> None:
    K = torch.tensor([[500.0, 0, 160], [0, 500, 120], [0, 0, 1]])
    solver = VideoSolver(given.rig, torch.arange(0, 612, 9), K)
    with pytest.raises(TorchfaceError, match=r"landmarks: found \(68, 2\), expected \(T,68,2\), a row a frame"):
        solver(torch.zeros(68, 2))


def test_arrays_and_lists_give_what_tensors_give(given: Given) -> None:
    g = given
    mesh = Mesh(g.v.double().numpy(), g.f.int().numpy())
    assert mesh.fingerprint() == g.mesh.fingerprint()
    assert mesh.vertices.dtype == torch.float32
    rig = BlendshapeRig(mesh, list(g.d), list(g.rig.names))
    assert torch.equal(rig([[0.5, 0, 0, 1]]), g.rig(torch.tensor([[0.5, 0, 0, 1]])))
    sites = Attachment(g.sites.triangles.numpy(), g.sites.barycentric.double().numpy())
    assert torch.equal(sites.on(g.f, g.v), g.sites.on(g.f, g.v))
    assert torch.equal(Track(("a",), np.ones((2, 1, 3))).values, torch.ones(2, 1, 3))
    solved = g.solver(g.markers)
    assert torch.equal(mesh.with_vertices(g.heads[0].numpy()).vertices, g.heads[0])
    for other in (g.markers.numpy(), g.markers.tolist()):
        torch.testing.assert_close(g.solver(other), solved, rtol=0, atol=1e-6)
        hybrid = HybridSolver(g.solver)(other, np.zeros((3, 4)), [[0.0] * 4] * 3)
        torch.testing.assert_close(hybrid, solved, rtol=0, atol=1e-6)
        assert WholeTakeSolver(g.solver)(other).shape == HelmetSolver(g.rig, g.sites)(other)[0].shape == solved.shape
    weights = [[0.1, 0.2, 0.0, 0.4]]
    assert torch.equal(g.prior.energy(weights).f, g.prior.energy(torch.tensor(weights)).f)
    expected = box_qp(g.H, g.q)
    H, q = g.H.numpy(), g.q.numpy()
    assert torch.equal(box_qp(g.H, g.q, [0, 0, 0], np.ones(3), start=q), expected)
    for found in (box_qp(H, q), BoxQP(H)(q), ProjectedGradient(H)(q)):
        assert found.dtype == torch.float64
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    assert simplex_qp(H.tolist(), q.tolist()).dtype == torch.float32
    model = MorphableModel.fit(g.heads.numpy())
    torch.testing.assert_close(model(np.ones((1, 3))), g.model(torch.ones(1, 3)))
    assert torch.equal(
        g.model.project(g.heads[:, 2:5], [2, 3, 4]), g.model.project(g.heads[:, 2:5], torch.arange(2, 5))
    )
    mask = torch.arange(len(g.v)) < 3
    for chosen in (mask, mask.numpy(), mask.tolist(), [0, 1, 2], np.arange(3, dtype=np.int32)):
        assert torch.equal(g.model.part(chosen).mean, g.model.mean[:3])
        assert torch.equal(g.model.project(g.heads[:, :3], chosen), g.model.project(g.heads[:, :3], torch.arange(3)))
    assert torch.equal(g.model.log_prob([[1.0, 2.0, 0.0]]), torch.tensor([-2.5]))
    torch.testing.assert_close(g.regression(g.v[None].numpy()), g.regression(g.v[None]))


def test_meshes_that_require_gradients_are_aligned_as_others(given: Given) -> None:
    head, ids = given.mesh, torch.arange(0, 600, 40)
    learned = head.with_vertices(head.vertices.clone().requires_grad_())
    expected = align_scan(head, head, (ids, head.vertices[ids] + 3.0)).similarity
    found = align_scan(learned, learned, (ids, learned.vertices[ids] + 3.0)).similarity
    assert torch.equal(found.translation, expected.translation)


def test_a_type_error_is_one_of_pythons_too(given: Given) -> None:
    with pytest.raises(TypeError):
        MarkerSolver(given.mesh, given.sites)
    assert issubclass(ArgumentTypeError, TorchfaceError)

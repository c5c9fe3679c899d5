"""The main job from end to end, with the truth known: rig, take, solve, files, a report.

A template rig is transferred to a new head; that head's true rig plays a performance on the marker stage; the take goes
to disk as C3D, comes back, is solved with the transferred rig, and what came back is compared with what was.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture import MarkerSolver, WholeTakeSolver
from torchface.capture.markers import Observability, observability
from torchface.errors import TopologyError, ValueRangeError
from torchface.evaluation import MeshError, WeightError, marker_rmse, mesh_error, weight_error, weight_jitter
from torchface.files.job_lock import holds_out, within_job
from torchface.io import (
    IdentityModes,
    load_identity_modes,
    load_mesh,
    load_rig,
    load_take,
    save_animation,
    save_mesh,
    save_rig,
    save_take,
)
from torchface.io.rigs.ict_facekit import is_ict_folder
from torchface.io.weights.live_link_csv import save_live_link
from torchface.io.weights.weight_csv import save_weights_csv
from torchface.mesh import Mesh
from torchface.modeling.rigging.deformation_transfer import TransferReport, transfer_with_report
from torchface.onnx import SolverReport
from torchface.onnx.solver_graph_export import export_marker_solver
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping
from torchface.synthetic import draw_identities, performer
from torchface.synthetic.head.embedded_character import shown_rig
from torchface.synthetic.stages.makeup_layout import MakeupLayout, makeup_layout
from torchface.synthetic.stages.marker_stage import Recording, StageFlaws, place_markers, record
from torchface.synthetic.stages.weight_curves import perform
from torchface.take import Take
from torchface.workflows.weight_files import weight_faults

FLAWS = StageFlaws(noise=0.3, missing=0.02, gaps=1.0, gap_seconds=0.4)
"""What a well run stage leaves: 0.3 mm noise, one sample in fifty lost, a short gap a marker and minute."""


@dataclass(frozen=True, eq=False)
class Scene:
    """What the demo plays: a template, a head that nobody has rigged, its true rig, and the weights that move it."""

    title: str  # for the report
    template: BlendshapeRig
    head: Mesh  # the new neutral
    truth: BlendshapeRig  # the rig that really is the new head's
    weights: Tensor  # (T,N), in the order of truth.names
    fps: float


@dataclass(frozen=True, eq=False)
class Solved:
    """Weights beside the true ones."""

    weights: Tensor  # (T,N)
    # weight_error, mesh_error: against the truth; the mesh's over the face
    weight_error: WeightError
    mesh_error: MeshError
    marker_rmse: Tensor  # (T,), millimetres, against the markers as seen
    jitter: float  # how many times as much as the true weights they tremble; see torchface.evaluation.weight_jitter

    @property
    def correlation(self) -> float:
        """Pearson's, of the median curve with the true one; of those that move at all."""
        known = self.weight_error.correlation
        return float(known[torch.isfinite(known)].median())


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What came out, beside what was true."""

    scene: Scene
    rig: BlendshapeRig  # the template transferred to the head
    transfer: TransferReport  # how that went
    attachment: Attachment  # where the markers sat
    # The make-up artist's, which has names for it; none where the rig has too little for one.
    layout: MakeupLayout | None
    recording: Recording
    solved: Solved  # the take solved at once, which is what the files hold
    frame_by_frame: Solved  # every frame on its own
    seconds: float  # what the solve at once took
    face: Tensor  # mask (V,) of the vertices that the mesh errors are about
    seen: Observability  # what the markers observe of the rig
    solver: SolverReport  # how the exported solver compares
    files: dict[str, Path]


def embedded_scene(seed: int, frames: int = 1800, progress: Progress = silent) -> Scene:
    """The mean performer's rig, a performer drawn at random, and a synthetic performance."""
    generator = torch.Generator().manual_seed(seed)
    progress("preparing head and take", 0, 2)
    truth = shown_rig(performer(draw_identities(1, generator)[0], texture=False))
    progress("preparing head and take", 1, 2)
    weights = perform(frames, generator)
    assert weights.weights is not None
    return Scene(
        f"The embedded performer, head {seed}",
        shown_rig(performer(texture=False)),
        truth.neutral,
        truth,
        truth.weights_from(weights.weights),
        weights.fps,
    )


def scene_from(
    template: Path | None, take: Path | None, target: Path | None, seed: int, progress: Progress = silent
) -> Scene:
    """A scene of the user's own parts; what is not given, the embedded performer gives.

    A template of ICT-FaceKit brings identity modes, from which the head is drawn by the seed. A target is a neutral of
    the template's topology; its true rig is then the template's deltas on it.
    """
    played = None if take is None else _weight_take(take)
    generator = torch.Generator().manual_seed(seed)
    if template is None:
        scene = embedded_scene(seed, progress=progress)
    else:
        rig = load_rig(template)
        if target is not None:
            head = load_mesh(target)
            title = f"{template.name} on {target.name}"
        elif is_ict_folder(template):
            modes: IdentityModes = load_identity_modes(template)
            head = modes.random_head(generator)
            title = f"{template.name}, random head {seed} of {len(modes.names)} identity modes"
        else:
            raise ValueRangeError(
                f"{template}: found no identity modes to draw a head from; expected a target (--target NEUTRAL)"
            )
        if head.fingerprint() != rig.neutral.fingerprint():
            raise TopologyError(f"target: found {head}, expected the triangles of {rig.neutral}")
        head = rig.neutral.with_vertices(head.vertices)
        truth = BlendshapeRig(head, rig.deltas, rig.names)
        performed = perform(1800, generator)
        assert performed.weights is not None
        scene = Scene(title, rig, head, truth, truth.weights_from(performed.weights), performed.fps)
    if played is None:
        return scene
    assert played.weights is not None
    weights = scene.truth.weights_from(played.weights).float().clamp(0, 1)
    return Scene(f"{scene.title}, {take and take.name}", scene.template, scene.head, scene.truth, weights, played.fps)


def _weight_take(path: Path) -> Take:
    played = load_take(path).resampled()
    if played.weights is None:
        raise ValueRangeError(
            f"{path}: found no weights, expected a take of blendshape weights such as Live Link Face's"
        )
    if not bool(torch.isfinite(played.weights.values).all()):
        raise ValueRangeError(f"{path}: found that {weight_faults(played.weights)[0]}; expected numbers")
    return played


@holds_out(within_job)
def run_demo(scene: Scene, out: Path, seed: int = 0, progress: Progress | None = None) -> DemoResult:
    """Plays a scene and writes every file of the main job into a folder."""
    progress = progress or silent
    files = {
        "template rig": out / "template.glb",
        "new head": out / "neutral.obj",
        "transferred rig": out / "actor.glb",
        "marker sites": out / "attachment.json",
        "marker take": out / "take.c3d",
        "solved weights": out / "weights.csv",
        "animated rig": out / "animation.glb",
        "solver for applications": out / "solver.onnx",
    }
    transferred = transfer_with_report(scene.template, scene.head, progress=progress)
    rig = transferred.rig
    save_rig(scene.template, files["template rig"])
    save_mesh(replace(scene.head, texture=None), files["new head"])
    save_rig(rig, files["transferred rig"])
    progress("capturing the markers")
    layout = _layout(scene.truth)
    attachment = (place_markers(scene.truth) if layout is None else layout.attachment).made_for(scene.head)
    attachment.save(files["marker sites"])
    generator = torch.Generator().manual_seed(seed)
    recording = record(scene.truth, attachment, scene.weights, generator, FLAWS, scene.fps)
    save_take(recording.take, files["marker take"])
    progress("solving the take", 0, 2)
    marker_solver = MarkerSolver(rig, attachment)
    captured = load_take(files["marker take"])
    started = time.perf_counter()
    solved = WholeTakeSolver(marker_solver).solve_take(captured)
    seconds = time.perf_counter() - started
    progress("solving the take", 1, 2)
    single = marker_solver.solve_take(captured)
    progress("writing weights and animation")
    live = bool(mapping(rig.names, ARKIT).any())
    (save_live_link if live else save_weights_csv)(solved, files["solved weights"])
    save_animation(rig, solved, files["animated rig"])
    some = recording.markers[:: max(1, len(recording.markers) // 300)]
    seen = some + FLAWS.noise * torch.randn(some.shape, generator=generator)
    solver = export_marker_solver(marker_solver, files["solver for applications"], markers=seen, progress=progress)
    progress("comparing with the truth")
    face = face_mask(scene.head)

    def compared(take: Take) -> Solved:
        assert take.weights is not None
        assert recording.take.markers is not None
        weights = take.weights.values[..., 0].float()
        return Solved(
            weights,
            weight_error(weights, scene.weights),
            mesh_error(rig, weights, scene.truth, scene.weights, face),
            marker_rmse(rig, attachment, weights, recording.take.markers.values),
            weight_jitter(weights) / max(weight_jitter(scene.weights), 1e-12),
        )

    return DemoResult(
        scene,
        rig,
        transferred.report,
        attachment,
        layout,
        recording,
        compared(solved),
        compared(single),
        seconds,
        face,
        observability(marker_solver),
        solver,
        files,
    )


def _layout(rig: BlendshapeRig) -> MakeupLayout | None:
    try:
        return makeup_layout(rig)
    except ValueRangeError:  # neither landmarks nor names to go by
        return None


def face_mask(mesh: Mesh) -> Tensor:
    """The annotated region ``face`` (V,), or every vertex where there is none."""
    return mesh.regions.get("face", torch.ones(len(mesh.vertices), dtype=torch.bool))

"""From raw scans of an actor and a template rig on disk to the actor's own rig on disk."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import (
    AlignmentError,
    FileFormatError,
    NameMismatchError,
    TopologyError,
    TorchfaceError,
    ValueRangeError,
)
from torchface.files.job_lock import file_lock, holds_out
from torchface.files.whole_files import all_or_none, check_writable, make_folder
from torchface.geometry.meshes.normal_maps import DetailMaps
from torchface.io import load_mesh, load_rig, save_rig
from torchface.io.maya.maya_writing import MAYA_ENDING
from torchface.io.rig_files import check_rig_ending
from torchface.io.rigs.ict_facekit import is_ict_folder
from torchface.landmarks import AutomaticLandmarks, UVLandmarkDetector
from torchface.mesh import Mesh
from torchface.modeling import (
    ExampleRig,
    ExpressionRegression,
    HeadModel,
    MorphableModel,
    NormalMap,
    RiggingSchedule,
    bake_normal_map,
    clear_parts,
    detail_maps,
    inner_parts,
    neutral_notes,
    neutral_rig,
    open_eyes,
    place_parts,
    rig_from_examples,
    transfer_with_report,
)
from torchface.modeling.rigging.ict_heads import mended_head
from torchface.modeling.rigging.neutral_check import pose_notes
from torchface.modeling.rigging.part_clearance import penetration
from torchface.modeling.rigging.part_placement import with_mouth_behind_skin, with_placed_parts
from torchface.progress import Progress, silent
from torchface.registration import Registration, in_place_of, load_scan_landmarks, register
from torchface.registration.landmark_files import landmark_file
from torchface.registration.own_topology import as_it_is
from torchface.registration.scan_colors import without_colors
from torchface.rendering.compositing import save_rendered_image
from torchface.rig import BlendshapeRig
from torchface.shape_names import mapping
from torchface.viz import registration_sheet
from torchface.workflows.register.register_scans import load_shape_model
from torchface.workflows.register.scan_expression import front_view, shown_expression
from torchface.workflows.rig.actor_report import ActorReport
from torchface.workflows.rig.expression_scans import (
    LAYOUT,
    Expression,
    check_expression,
    check_side,
    expressions_in,
    neutral_in,
    seen_example,
    shared_notes,
    weights_row,
)
from torchface.workflows.rig.shut_eyes import with_eye_note
from torchface.workflows.rig_names import Naming, renamed, renamed_detail

FIGURE_ENDING = "_registration.png"
"""Ends the name of the figure that lies beside a rig."""
_FOLLOWS = 1.0  # millimetres; a vertex that an expression moves by this much counts half as much for the head's place
# Registered scans are noisier than shapes are a person's own, and what they show is only roughly given.
_SCANNED = RiggingSchedule(beta=(0.5, 0.1), gamma=(25.0, 25.0))


@dataclass(frozen=True)
class RigOptions:
    """How the files are read and what is made of them."""

    part: str | None = None  # keep this region of the template only
    unit: str | None = None  # of all scans, where it is not each format's own
    # what the neutral scan shows in the template's shapes, such as closed eyes; the actor's neutral is opened again by
    # deformation transfer
    pose: dict[str, float] = field(default_factory=dict)
    detector: str | Path | None = None  # of landmarks, by name or folder, for scans without landmarks
    # of heads in the template's topology, by name or folder; the neutral's registration is initialised by it
    model: str | Path | None = None
    texture_size: int = 2048  # of the actor's texture, texels a side
    detail_size: int = 2048  # of each normal map, texels a side
    names: Naming | None = None  # of the written shapes; see `rig_names.renamed`
    colors: bool = True  # whether the scans' colours are used, to find hair and as the actor's
    # a regression of expressions, by name or folder, which predicts those of the shapes that it knows
    expressions: str | Path | None = None


@holds_out(file_lock)
def rig_actor(
    scan: Path,
    template: Path,
    out: Path,
    landmarks: Path | None = None,
    examples: Path | None = None,
    detail: Path | None = None,
    options: RigOptions | None = None,
    progress: Progress | None = None,
) -> ActorReport:
    """Registers the neutral scan, transfers the shapes, learns from examples, bakes normal maps, writes the rig.

    Beside the rig lies a figure of the registration, ``NAME_registration.png``: the scan, the face, its distances to
    the scan, its mesh.

    Args:
        landmarks: of the scan; see ``load_scan_landmarks``. Found by shape alone if absent.
        examples: a folder of scans of expressions; see ``expressions_in``. Landmark files named as the scans may lie
            beside them.
        detail: a folder of high-resolution scans, named for the one shape that each shows at full strength, and
            ``neutral``.
    """
    check_out(out)
    if detail is not None and out.suffix.lower() == MAYA_ENDING:
        raise FileFormatError(f"{out}: found detail maps ({detail}) for a .ma file, expected .glb or USD for them")
    options, progress = options or RigOptions(), progress or silent
    progress("reading the template")
    rig = load_template(template, options.part)
    shown = weights_row(options.pose, rig.names, "--pose") if options.pose else torch.zeros(len(rig.names))
    expressions = [] if examples is None else expressions_in(examples, rig.names)
    if examples is not None and not expressions:
        raise FileFormatError(f"{examples}: found no scan of an expression, expected {LAYOUT}")
    fine = [] if detail is None else _detail_scans(detail, rig)
    if options.expressions is not None and expressions:
        raise ValueRangeError("examples: found them beside a model of expressions, expected one of the two")
    regression = None if options.expressions is None else load_expressions(options.expressions, rig, template)
    job = _Actor(rig, options, progress)
    progress("registering the neutral scan")
    model = None if options.model is None else load_shape_model(options.model)
    if model is not None and bool(shown.any()):
        raise ValueRangeError("model: found a pose beside a model of heads at rest, expected one of the two")
    registration = job.registered(job.posed(rig, shown), scan, landmarks, options.texture_size, model)
    bent, parts, view = registration.record.bent, inner_parts(rig), None
    if bent:
        progress("looking at the scan")
        view = front_view(job.read(scan), registration, rig.neutral)
        registration = with_eye_note(
            rig,
            view,
            registration,
            shown,
            lambda weights: job.registered(job.posed(rig, weights), scan, landmarks, 0),
        )
        # Before it is drawn: teeth and eyes of the other are where they belong.
        as_shown = BlendshapeRig(job.posed(rig, shown), rig.deltas, rig.names)
        registration = with_placed_parts(as_shown, registration)
    found = _upright(registration, rig.neutral)
    neutral = _at_rest(rig, shown, found)
    if bent and bool(shown.any()):
        neutral = with_mouth_behind_skin(place_parts(rig, neutral, parts))
    transferred = transfer_with_report(rig, neutral, progress=progress)
    doubts = (*pose_notes(rig, found, shown), *neutral_notes(rig, neutral))
    seen = "" if view is None else shown_expression(view, rig.names, shown)
    if seen and not any("neutral is likely not at rest" in doubt for doubt in doubts):
        doubts += (
            f"the scan is likely not at rest: from the front it shows {seen}, as the landmark network sees it, and so "
            f"does the neutral; torchface rig --pose {seen} takes it out",
        )
    notes = (*registration.record.notes, *(f"warning: {note}" for note in doubts))
    notes += tuple(shared_notes(expressions, shown, rig.names))
    registration = replace(registration, record=replace(registration.record, notes=notes))
    actor: BlendshapeRig = transferred.rig
    predicted = None if regression is None else neutral_rig(regression, rig, neutral)
    if predicted is not None:
        actor = clear_parts(predicted.rig, parts)
    learned: ExampleRig | None = None
    used: tuple[str, ...] = ()
    if expressions:
        learned, used = job.learned(actor, neutral, registration.matched, expressions)
        actor = clear_parts(learned.rig, parts)
    maps = job.baked(actor, fine)
    progress("drawing the registration")
    views = registration_sheet(load_mesh(scan, options.unit), registration)
    progress("writing the rig")
    figure = out.with_name(f"{out.stem}{FIGURE_ENDING}")
    with all_or_none():
        save_rig(renamed(actor, options.names), out, renamed_detail(_detail(maps), actor, options.names))
        save_rendered_image(views, figure)
    names = {label: baked for label, (_, baked) in maps.items()}
    return ActorReport(
        actor,
        registration,
        transferred.report.summary(),
        learned,
        used,
        names,
        tuple(job.skipped),
        figure,
        penetration(actor, parts),
        0 if predicted is None else int(predicted.learned.sum()),
    )


def load_template(path: Path, part: str | None = None) -> BlendshapeRig:
    """A template rig, or a part of it; of ICT-FaceKit's folder with lips that meet, blinks that shut, teeth in
    sight."""
    rig = load_rig(path, part=part)
    return mended_head(rig)[0] if is_ict_folder(path) else rig


def load_expressions(name_or_path: str | Path, template: BlendshapeRig, path: Path | None) -> ExpressionRegression:
    """A regression of expressions for the template's topology; ``path`` is None for the embedded performer."""
    model = zoo.get_model(name_or_path, ExpressionRegression)
    wanted, named = template.neutral.fingerprint(), "the embedded performer" if path is None else str(path)
    if (model.topology or wanted) != wanted or len(model.neutral_mean) != len(template.vertices):
        raise TopologyError(
            f"expressions: found {name_or_path} of topology {model.topology or len(model.neutral_mean)}, expected that "
            f"of {named}, {wanted} (vertices, hash of the triangles); learn one by `torchface train expression`"
        )
    if not mapping(model.names, template.names).any():
        raise NameMismatchError(
            f"expressions: found {name_or_path} of {', '.join(model.names[:5])}, expected some of the shapes of {named}"
        )
    return model


class _Actor:
    """The steps, and what had to be skipped on the way."""

    def __init__(self, template: BlendshapeRig, options: RigOptions, progress: Progress) -> None:
        self.template, self.options, self.progress = template, options, progress
        self.skipped: list[str] = []

    def read(self, scan: Path) -> Mesh:
        mesh = load_mesh(scan, self.options.unit)
        return mesh if self.options.colors else without_colors(mesh)

    @staticmethod
    def posed(rig: BlendshapeRig, weights: Tensor) -> Mesh:
        return rig.neutral.with_vertices(rig(weights[None].to(rig.deltas))[0])

    def registered(
        self,
        mesh: Mesh,
        scan: Path,
        landmarks: Path | None,
        texture_size: int,
        model: MorphableModel | HeadModel | None = None,
    ) -> Registration:
        options, read = self.options, self.read(scan)
        if read.fingerprint() == mesh.fingerprint():
            return as_it_is(mesh, read)
        marks = None if landmarks is None else load_scan_landmarks(landmarks, mesh, scan, options.unit)
        detector = None
        if marks is None and options.detector is not None:
            detector = AutomaticLandmarks(zoo.get_model(options.detector, UVLandmarkDetector), mesh)
        return register(mesh, read, marks, model=model, detector=detector, texture_size=texture_size)

    def learned(
        self, actor: BlendshapeRig, neutral: Mesh, matched: Tensor, expressions: list[Expression]
    ) -> tuple[ExampleRig, tuple[str, ...]]:
        """The rig from the examples that could be registered, and their names."""
        vertices, weights, used = [], [], []
        for number, expression in enumerate(expressions):
            self.progress("registering examples", number, len(expressions))
            # The transferred rig in that expression is nearer to the scan than the actor at rest.
            guess = self.posed(actor, expression.weights)
            try:
                marks = landmark_file(expression.path.parent, expression.path)
                registered = self.registered(guess, expression.path, marks, texture_size=0)
                moved = (guess.vertices - neutral.vertices).norm(dim=-1)
                steady = registered.matched / (1 + (moved / _FOLLOWS) ** 2)
                aligned = in_place_of(registered.mesh, guess, steady.double())
                for check in (check_side, check_expression):
                    check(actor, expression.weights, aligned.vertices, registered.matched & matched)
            except TorchfaceError as error:
                self.skipped.append(f"example {expression.path.name}: {error}")
                continue
            vertices.append(seen_example(aligned, guess.vertices, registered.matched & matched))
            weights.append(expression.weights)
            used.append(expression.name)
        if not used:
            raise AlignmentError(f"examples: none of {len(expressions)} could be used; {self.skipped[0]}")
        rig = rig_from_examples(
            self.template, neutral, torch.stack(vertices), torch.stack(weights), _SCANNED, progress=self.progress
        )
        return rig, tuple(used)

    def baked(self, actor: BlendshapeRig, fine: list[Expression]) -> dict[str, tuple[tuple[str, ...], NormalMap]]:
        """For each scan of details the shapes that it shows (none: the neutral) and the map."""
        maps: dict[str, tuple[tuple[str, ...], NormalMap]] = {}
        for number, one in enumerate(fine):
            self.progress("baking normal maps", number, len(fine))
            shapes = tuple(actor.names[i] for i in one.weights.nonzero()[:, 0].tolist())
            try:
                scan = load_mesh(one.path, self.options.unit)
                maps[one.name] = shapes, bake_normal_map(self.posed(actor, one.weights), scan, self.options.detail_size)
            except TorchfaceError as error:
                self.skipped.append(f"details {one.path.name}: {error}")
        if fine and not maps:
            raise AlignmentError(f"detail: none of {len(fine)} scans could be used; {self.skipped[-1]}")
        return maps


def _upright(registration: Registration, template: Mesh) -> Mesh:
    """The registered face, rotated and translated to the template's pose, in its own size."""
    return in_place_of(registration.mesh, template, registration.matched.double())


def _at_rest(rig: BlendshapeRig, weights: Tensor, found: Mesh) -> Mesh:
    """The face at rest of a scan that shows some of the template's shapes."""
    shown = [rig.names[i] for i in weights.nonzero()[:, 0].tolist()]
    if not shown:
        return found
    # What opens closed eyes takes any shapes back; these are as strong as the scan shows them.
    as_shown = BlendshapeRig(rig.neutral, rig.deltas * weights.to(rig.deltas)[:, None, None], rig.names)
    return open_eyes(as_shown, found, shown)


def _detail_scans(folder: Path, rig: BlendshapeRig) -> list[Expression]:
    """The neutral first (weights of zero), then those of one shape each."""
    neutral = neutral_in(folder) if folder.is_dir() else None
    rest = [] if neutral is None else [Expression(neutral, torch.zeros(len(rig.names)))]
    shapes = expressions_in(folder, rig.names)
    if not rest and not shapes:
        raise FileFormatError(f"{folder}: found no scan, expected neutral.obj and shapes such as jawOpen.obj")
    taken: dict[int, Expression] = {}
    for one in shapes:
        if bool(((one.weights != 0) & (one.weights != 1)).any()):
            raise ValueRangeError(f"{one.path}: found weights below 1, expected one shape at full strength a scan")
        for shape in one.weights.nonzero()[:, 0].tolist():
            if shape in taken:
                raise ValueRangeError(
                    f"{one.path}: found a second scan for {rig.names[shape]} beside {taken[shape].path.name}, expected "
                    "one a shape"
                )
            taken[shape] = one
    return rest + shapes


def _detail(maps: dict[str, tuple[tuple[str, ...], NormalMap]]) -> DetailMaps | None:
    if not maps:
        return None
    neutral = next((baked for shapes, baked in maps.values() if not shapes), None)
    named = [(shape, baked) for shapes, baked in maps.values() for shape in shapes]
    if not named:
        assert neutral is not None
        return DetailMaps((), torch.zeros(0, *neutral.normals.shape), neutral.normals)
    return detail_maps([shape for shape, _ in named], [baked for _, baked in named], neutral)


def check_out(out: Path) -> None:
    """Refuses what a rig cannot be written to, before any work is done."""
    check_rig_ending(out)
    if out.suffix:
        check_writable(out)
    else:
        check_writable(folder=out)
    make_folder(out.parent)

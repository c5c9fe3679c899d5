"""Heads, animations and weights on disk to ARKit's and back."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.capture.markers import MeshSolution, MeshSolver
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.escaped_text import listed
from torchface.files.documents import read_json
from torchface.files.whole_files import all_or_none, check_ending, check_writable, make_folder, write_file
from torchface.geometry.similarity import Similarity
from torchface.io import load_take, save_rig
from torchface.io.take_files import RECORDING_ENDINGS
from torchface.number_checks import check_rate
from torchface.optim import BoxQP
from torchface.progress import Progress
from torchface.rendering.compositing import save_rendered_image
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, mapping, recognised_shapes
from torchface.take import Take, Track
from torchface.viz.figures.character_views import SHOWN, character_sheet
from torchface.workflows.animated_meshes import known_rate, rate_notes
from torchface.workflows.arkit.arkit_rig import Source, is_annotated, load_source, make_arkit
from torchface.workflows.arkit.head_parameters import HeadParameters, parameters_of, save_parameters
from torchface.workflows.arkit.moving_head import MAX_JSON, load_moving_head
from torchface.workflows.rig.actor_rig import check_out
from torchface.workflows.rig.character_face import plain_surface
from torchface.workflows.rig.character_job import FACE_SPAN
from torchface.workflows.rig.character_rig import PICTURE_ENDING
from torchface.workflows.weight_files import WeightFiles, write_weights

_ENOUGH = 45  # of ARKit's shapes: such a rig is taken as it is
_UNITS = (1.0, 10.0, 1000.0)
_UNIT_NAMES = {1.0: "millimetres", 10.0: "centimetres", 1000.0: "metres"}
_SHOWN_FRAMES = 200
_NO_FACE_MM = 10.0  # faces that ARKit's shapes do not show are 0.2 to 3 mm away
_LEFT_MM, _LEFT_SHARE, _SHOWN = 0.2, 0.1, 6


@dataclass(frozen=True)
class AnimationSettings:
    """How an animation becomes weights; see ``torchface arkit --help``."""

    template: Path | None = None
    landmarks: Path | None = None
    everything: bool = False
    temporal: bool = True
    fps: float | None = None
    unit: str | None = None


def arkit_head(
    source: Path,
    out: Path,
    template: Path | None,
    landmarks: Path | None,
    everything: bool,
    unit: str | None,
    progress: Progress,
) -> list[str]:
    """Reads, makes, writes a rig; lines for people to read."""
    check_out(out)
    progress("reading the head")
    made = make_arkit(load_source(source, unit), template, landmarks, everything, progress)
    progress("writing the rig")
    with all_or_none():
        save_rig(made.rig, out)
        lines = made.lines()
        if made.pose is not None and is_annotated(made.rig.neutral):
            figure = out.with_name(f"{out.stem}{PICTURE_ENDING}")
            save_rendered_image(_views(made.rig, made.pose), figure)
            lines.insert(1, f"the face before and after: {figure}")
    return lines


def _views(rig: BlendshapeRig, pose: Similarity) -> Tensor:
    """The face at rest and with shapes on, upright and at a head's size."""
    back = pose.inverse()
    upright = back.apply(rig.vertices.double())[0]
    names = [name for some in SHOWN.values() for name in some if name in rig.names]
    moved = {name: back.apply_vectors(rig.deltas[[rig.index([name])[0]]].double())[0] for name in names}
    middle = upright[rig.neutral.landmarks[17:]].mean(0)
    return character_sheet(plain_surface(upright, rig.neutral.faces), moved, middle, FACE_SPAN)


def animation_to_weights(
    source: Path, animation: Path, out: Path, settings: AnimationSettings, progress: Progress
) -> list[str]:
    """Reads, solves, writes weights, and the error of each frame beside; lines for people to read."""
    files = WeightFiles(out)
    files.check()
    if settings.fps is not None:
        check_rate(settings.fps, "--fps", ValueRangeError)
    progress("reading the animation")
    if (named := _named_weights(animation, settings.fps)) is not None:
        if rate_notes(animation, named.fps, settings.fps):
            raise ValueRangeError(
                f"--fps: found {settings.fps:g}, expected none beside weights, which {animation} has {named.rate}"
            )
        return _renamed(named, animation, files)
    head = load_source(source, settings.unit)
    moving = load_moving_head(animation, head)
    rig, notes = arkit_shapes(head, settings, progress)
    if moving.person is not None:
        # As the model's expressions, which are the same on everybody: then a code has one answer.
        rig = BlendshapeRig(rig.neutral.with_vertices(moving.person), rig.deltas, rig.names)
    solver = MeshSolver(rig)
    scale, note = _unit_factor(solver, moving.read(0, 1)[0], animation)
    read = (lambda begin, end: moving.read(begin, end) * scale) if note else moving.read
    fps = known_rate(moving.fps, settings.fps)
    solution = solver.solve(read, moving.count, fps, settings.temporal, progress)
    broken = _broken_frames(solution, animation)
    take = Take(fps, weights=Track(rig.names, solution.weights.float()[..., None]))
    warnings, _ = write_weights(_all_of_arkit(take), files, rig)
    error_file = out.with_name(f"{out.stem}_error.csv")
    _write_errors(solution, fps, error_file)
    lines = [
        *notes,
        *moving.notes,
        *note,
        *broken,
        *rate_notes(animation, moving.fps, settings.fps),
        *solution_lines(solution, fps),
        *unsaid_lines(solver, solution, read, rig),
    ]
    if moving.parameters is not None and head.model is not None:
        lines += parameter_lines(solver, head, moving.parameters)
    return [*lines, *warnings, f"error of each frame: {error_file}"]


def weights_back(
    source: Path, weights: Path, out: Path, template: Path | None, landmarks: Path | None, progress: Progress
) -> list[str]:
    """Reads ARKit weights, writes the head model's parameters; lines for people to read."""
    check_ending(out, ".npz")
    check_writable(out)
    head = load_source(source)
    if head.model is None or not len(head.model.expressions):
        raise FileFormatError(
            f"{source}: found no expression parameters, expected a head model that has some; weights go onto a rig by "
            "torchface retarget"
        )
    take = load_take(weights)
    if take.weights is None:
        raise ValueRangeError(f"{weights}: found no weights, expected a take of them")
    made = make_arkit(head, template, landmarks, progress=progress)
    progress("solving")
    values = made.rig.weights_from(take.weights)
    parameters, left = parameters_of(head.model, made.rig, values)
    make_folder(out.parent)
    save_parameters(parameters, head.model.joints, take.fps, out)
    moved = torch.tensordot(values.double(), made.rig.deltas.double(), 1).square().sum(-1).mean(1).sqrt()
    return [
        *made.notes,
        f"{len(values)} frames; {head.model.name}'s parameters come to {float(left.mean()):.3f} mm of ARKit's faces "
        f"(root mean square; they move {float(moved.mean()):.2f} mm)",
    ]


def arkit_shapes(head: Source, settings: AnimationSettings, progress: Progress) -> tuple[BlendshapeRig, list[str]]:
    """The rig whose weights an animation becomes, and notes: the source itself where it has ARKit's shapes."""
    if head.rig is not None and not settings.everything:
        rig, own = head.rig.linear("torchface arkit"), recognised_shapes(head.rig.names)
        if len(own) >= _ENOUGH:
            deltas = torch.stack([rig.deltas[list(shape.rows)].sum(0) for shape in own.values()])
            return BlendshapeRig(rig.neutral, deltas, tuple(own)), []
    made = make_arkit(head, settings.template, settings.landmarks, settings.everything, progress)
    return made.rig.select([name for name in made.rig.names if name in ARKIT]), list(made.notes)


def _named_weights(path: Path, fps: float | None) -> Take | None:
    """The weights of a recording that has weights by name and no vertices, as of Audio2Face; None of another file."""
    if path.suffix.lower() not in (".csv", *RECORDING_ENDINGS):
        return None
    if path.suffix.lower() == ".json":
        found = read_json(path, max_bytes=MAX_JSON).found
        frames = found.get("frames") if isinstance(found, dict) else found
        first = frames[0] if isinstance(frames, list) and frames else {}
        if isinstance(first, dict) and ("vertices" in first or "geometry" in first):
            return None
    return load_take(path, fps=fps)


def _renamed(take: Take, path: Path, files: WeightFiles) -> list[str]:
    """Writes weights that go by names to ARKit's."""
    if take.weights is None:
        raise ValueRangeError(f"{path}: found no weights, expected weights, parameters or meshes over time")
    matrix = mapping(take.weights.names, ARKIT).to(take.weights.values)
    if not matrix.any():
        raise NameMismatchError(
            f"{path}: found {', '.join(take.weights.names[:5])}, ..., expected some of ARKit's names; torchface "
            "retarget --table maps others"
        )
    lost = [name for name, used in zip(take.weights.names, matrix.any(0).tolist(), strict=True) if not used]
    values = take.weights.values[..., 0] @ matrix.T
    arkit = replace(take, weights=Track(ARKIT, values[..., None]))
    write_weights(arkit, files, _no_rig())
    left = f"; ARKit has no {listed(lost)}" if lost else ""
    return [f"{len(take)} frames of weights by name, {take.rate}{left}"]


def _no_rig() -> BlendshapeRig:
    from torchface.mesh import Mesh

    return BlendshapeRig(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]])), torch.zeros(len(ARKIT), 3, 3), ARKIT)


def _all_of_arkit(take: Take) -> Take:
    """All 52 columns, those that the rig lacks at zero, so that every program takes the file."""
    assert take.weights is not None
    matrix = mapping(take.weights.names, ARKIT).to(take.weights.values)
    return replace(take, weights=Track(ARKIT, (take.weights.values[..., 0] @ matrix.T)[..., None]))


def _unit_factor(solver: MeshSolver, first: Tensor, path: Path) -> tuple[Tensor, list[str]]:
    """What the meshes' coordinates (3,) are multiplied by to be right-handed millimetres; notes where that is not 1."""
    factor, notes = torch.ones(3), list[str]()
    if solver.is_mirrored(first):
        factor = torch.tensor([1.0, 1.0, -1.0])
        notes.append(f"{path.name}: mirrored, as by left-handed axes (Unity, Unreal); taken with z the other way")
    scale = solver.scale_of(first * factor)
    for unit in _UNITS:
        if 0.7 <= scale * unit <= 1.4:
            note = f"{path.name}: taken to be in {_UNIT_NAMES[unit]}, by the head's size"
            return unit * factor, [*notes, *([] if unit == 1 else [note])]
    solver.check_unit(first * factor)
    return factor, notes


def _broken_frames(solution: MeshSolution, path: Path) -> list[str]:
    """A warning of frames that no expression comes near; refused where these are half of them or more."""
    error, worst = solution.error, int(solution.error.argmax())
    count = int((error > _NO_FACE_MM).sum())
    found = (
        f"{path.name}: {count} of {len(error)} frames lie more than {_NO_FACE_MM:g} mm from all that ARKit's shapes "
        f"show, frame {worst} by {float(error[worst]):.1f} mm (root mean square over the vertices)"
    )
    if 2 * count >= len(error):
        raise ValueRangeError(f"{found}, expected expressions of this head: its order of vertices, its unit, radians")
    return [f"warning: {found}"] if count else []


def _write_errors(solution: MeshSolution, fps: float, path: Path) -> None:
    rows = ["frame,time,error_mm,least_squares_mm,motion_mm"]
    table = torch.stack([solution.error, solution.unbounded, solution.motion], 1).tolist()
    rows += [f"{row},{row / fps:.4f},{a:.4f},{b:.4f},{c:.4f}" for row, (a, b, c) in enumerate(table)]
    write_file(path, ("\n".join(rows) + "\n").encode())


def solution_lines(solution: MeshSolution, fps: float) -> list[str]:
    """How many frames there are, and what the weights leave, for people to read."""
    error, motion = solution.error, solution.motion
    share = float(error.square().sum() / motion.square().sum().clamp(min=1e-12))
    return [
        f"{len(error)} frames at {fps:.6g} a second; error {float(error.mean()):.3f} mm (root mean square over the "
        f"vertices, mean of frames; 95 % of the frames below {float(error.quantile(0.95)):.3f}) of "
        f"{float(motion.mean()):.2f} mm of motion, "
        f"{share:.1%} of its energy; least squares without bounds {float(solution.unbounded.mean()):.3f} mm"
    ]


def unsaid_lines(
    solver: MeshSolver, solution: MeshSolution, read: Callable[[int, int], Tensor], rig: BlendshapeRig
) -> list[str]:
    """The regions whose motion ARKit's shapes cannot show, the worst first; of at most 200 frames."""
    notes = rig.neutral.annotations
    if notes is None or not notes.regions:
        return []
    frames = torch.linspace(0, len(solution.weights) - 1, min(_SHOWN_FRAMES, len(solution.weights))).round().long()
    left = torch.zeros(len(rig.vertices), dtype=torch.float64)
    moved = torch.zeros_like(left)
    for frame in frames.tolist():  # frames of a file are read one at a time
        residual, motion = solver.residual(read(frame, frame + 1), solution.weights[frame : frame + 1])
        left += residual[0].square().sum(-1)
        moved += motion[0].square().sum(-1)
    found = []
    for name, mask in notes.regions.items():
        if mask.any():
            error = float((left[mask].mean() / len(frames)).sqrt())
            share = float(left[mask].sum() / moved[mask].sum().clamp(min=1e-12))
            if error > _LEFT_MM and share > _LEFT_SHARE:
                found.append((error, share, name))
    listed = [f"{name} {error:.2f} mm ({share:.0%})" for error, share, name in sorted(found, reverse=True)[:_SHOWN]]
    return [f"ARKit's shapes cannot show: {', '.join(listed)} of the motion there"] if listed else []


def parameter_lines(solver: MeshSolver, head: Source, parameters: HeadParameters) -> list[str]:
    """The parameters whose motion, as far as the take uses them, ARKit's shapes show worst."""
    assert head.model is not None
    used = parameters.expressions.double().square().mean(0).sqrt()
    rows = head.model.expressions[: len(used)].double() * used[:, None, None]
    meshes = torch.cat([solver.rest + rows, solver.rest - rows])
    slopes, constant = solver.equations(meshes)
    left = solver.error(slopes, constant, BoxQP(solver.H, 0.0, 1.0)(slopes)).view(2, -1).amax(0)
    size = solver.error(slopes, constant, torch.zeros_like(slopes)).view(2, -1).amax(0)
    worst = left.argsort(descending=True)[:_SHOWN].tolist()
    listed = [
        f"{head.model.expression_names[row]} {float(left[row]):.2f} of {float(size[row]):.2f} mm"
        for row in worst
        if float(left[row]) > _LEFT_SHARE * float(size[row]) and float(left[row]) > 0.02
    ]
    return (
        [f"parameters that ARKit's shapes show worst, as far as they are used: {', '.join(listed)}"] if listed else []
    )

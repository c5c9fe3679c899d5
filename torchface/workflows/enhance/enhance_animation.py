"""The whole job: read, enhance, write meshes, an animated ``.glb``, a video, tables and a summary."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from torchface import zoo
from torchface.enhancement import EnhancementModel
from torchface.errors import AlignmentError, NameMismatchError, TopologyError, ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.documents import write_json
from torchface.files.job_lock import within_job
from torchface.files.whole_files import all_or_none, made_folder, make_folder
from torchface.geometry.meshes.rasterization import TexelMap, rasterise_uvs
from torchface.io import MeshSequence, load_mesh, save_animation, save_image, save_mesh
from torchface.io.tables.csv_table import write_table
from torchface.io.video import write_video
from torchface.mesh import Mesh
from torchface.optim.eigenpairs import largest_eigenpairs
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.workflows.enhance.coarse_animation import OWN_HEAD_MM, SAME_TOPOLOGY, CoarseAnimation
from torchface.workflows.enhance.coarse_input import InputSettings, read_coarse
from torchface.workflows.enhance.enhance_views import drawn_frames, framed_model
from torchface.workflows.enhance.enhanced_frames import (
    SEQUENCE,
    EnhancedFrames,
    enhance_frames,
    has_colors,
    retimed_animation,
)

MEGABYTES = 200.0
_BYTES_A_VERTEX = 24  # of a target: position and normal
_EXACT_MM = 0.005
_SAMPLE_BYTES = 5 * 2**28
_MOST_SAMPLED = 200
_CHUNK = 8


@dataclass(frozen=True, eq=False)
class AnimationTargets:
    """An animation as morph targets."""

    kind: str  # frames, a target a frame, or components, the principal components of all frames
    deltas: Tensor  # of the targets, (N,V,3), millimetres
    weights: Tensor  # of every frame, (T,N); components are weighed below 0 too
    # rms, largest: how far the frames that these give are from those they were made of: root mean square over all
    # vertices and frames, and the worst frame's root mean square, millimetres
    rms: float
    largest: float


def animation_targets(
    sequence: MeshSequence, neutral: Tensor, megabytes: float, progress: Progress
) -> AnimationTargets:
    r"""Every frame (T,V,3) as a target where these take no more megabytes, else as few principal components as show it.

    Components are those of frames spread over the animation, as many as leave 0.005 mm, root mean square, or as fit.
    Their weights in all frames are projections: no frame is left out.
    """
    frames, vertices = sequence.shape[:2]
    most = int(megabytes * 1e6 // (_BYTES_A_VERTEX * vertices))
    if most < 1:
        raise ValueRangeError(
            f"--glb-megabytes: found {megabytes:g}, expected at least {_BYTES_A_VERTEX * vertices / 1e6:.0f} for one "
            f"morph target of {vertices} vertices"
        )
    if frames <= most:
        return AnimationTargets("frames", sequence.read(0, frames) - neutral, torch.eye(frames), 0.0, 0.0)
    sampled = min(frames, _MOST_SAMPLED, max(2 * most, _SAMPLE_BYTES // (12 * vertices)))
    rows = torch.linspace(0, frames - 1, sampled).round().long().unique().tolist()
    offsets = torch.empty(len(rows), 3 * vertices)
    for number, row in enumerate(rows):  # a frame at a time: they lie far apart on disk
        offsets[number] = (sequence.read(row, row + 1)[0] - neutral).reshape(-1)
        progress("finding morph targets", number + 1, len(rows))
    values, vectors = largest_eigenpairs(offsets @ offsets.T)
    values = values.clamp(min=0)
    left = values.sum() - values.cumsum(0)
    enough = (left / (len(rows) * vertices)).sqrt() <= _EXACT_MM
    wanted = int(enough.nonzero()[0, 0]) + 1 if enough.any() else len(values)
    count = max(1, min(most, wanted, int((values > 1e-12 * values[0]).sum())))
    basis = (vectors[:, :count] / values[:count].sqrt()).T.float() @ offsets
    del offsets
    weights, error = torch.empty(frames, count), torch.empty(frames, dtype=torch.float64)
    for begin in range(0, frames, _CHUNK):
        some = (sequence.read(begin, begin + _CHUNK) - neutral).flatten(1)
        own = some @ basis.T
        weights[begin : begin + len(some)] = own
        error[begin : begin + len(some)] = (some - own @ basis).double().square().sum(1) / vertices
        progress("weighing morph targets", begin + len(some), frames)
    size = weights.abs().amax(0).clamp(min=1e-12)
    deltas = (basis * size[:, None]).reshape(count, vertices, 3)
    return AnimationTargets("components", deltas, weights / size, float(error.mean().sqrt()), float(error.max().sqrt()))


def write_targets(targets: AnimationTargets, neutral: Mesh, fps: float, path: Path) -> None:
    """Writes them as an animated ``.glb``."""
    names = tuple(f"{targets.kind.removesuffix('s')}_{i + 1:03d}" for i in range(len(targets.deltas)))
    rig = BlendshapeRig(neutral, targets.deltas, names)
    save_animation(rig, Take(fps, weights=Track(names, targets.weights[..., None])), path)


STATE = "state"
GLB, VIDEO, FRAMES, SUMMARY = "enhanced.glb", "comparison.mp4", "frames.csv", "summary.json"
MESHES, TEXTURES = "meshes", "textures"
_METHOD = "enhance/4"
_FORMAT = "torchface.enhance-summary/1"
_MANY_OUTSIDE = 0.25
_BADLY_SHOWN_MM = 0.1
_ANOTHER, _ASKED = 0.75, 4  # of the regions of so many frames outside


@dataclass(frozen=True)
class EnhanceSettings:
    """What is written."""

    given: InputSettings = field(default_factory=InputSettings)  # how the input is read
    meshes: Literal["none", "obj", "ply"] = "none"  # also every frame as a mesh file of this kind
    glb: bool = True  # the animated .glb
    megabytes: float = MEGABYTES  # that its morph targets may take
    detail: float = 1.0  # how strong the detail is; 1 is the actor's
    video: bool = True  # the video of input and result side by side
    retime: bool = False  # give the motions between the animation's keyframes the actor's timing first
    textures: Path | None = None  # a mesh in whose texture coordinates colours are written, an image a frame
    texture_size: int = 1024  # pixels a side


@dataclass(frozen=True, eq=False)
class Enhanced:
    """What came of an animation."""

    animation: CoarseAnimation
    model: EnhancementModel
    model_name: str
    frames: EnhancedFrames
    mesh: Mesh  # the model's neutral, framed by what moves
    products: dict[str, Path]
    notes: tuple[str, ...]  # lines for people to read; warnings begin with warning:

    @property
    def outside_share(self) -> float:
        """Of the frames, those that the database does not hold in some region."""
        return float(self.frames.outside.any(1).float().mean())

    def lines(self) -> list[str]:
        """For people to read."""
        count, vertices = self.animation.count, len(self.model.neutral)
        lines = [
            f"{count} frames of {self.animation.kind} on {vertices} vertices, {self.animation.fps:g} a second; model "
            f"{self.model_name}, {len(self.model.sequences)} frames, {self.model.fps:g} a second, "
            f"{len(self.model.regions.names)} regions",
            f"{self.outside_share:.0%} of the frames are outside of what the model has seen in some region"
            + (" (there detail is a guess, and far away but the nearest)" if self.outside_share else ""),
        ]
        if self.frames.enhanced:
            rate = self.frames.enhanced / max(self.frames.seconds, 1e-9)
            lines.append(f"{self.frames.enhanced} frames enhanced in this run, {rate:.2f} a second")
        else:
            lines.append("all frames were enhanced by an earlier run")
        return [*lines, *self.notes]


def load_model(name_or_path: str) -> EnhancementModel:
    """An actor's model by name or folder, see ``zoo.get_model``."""
    model = zoo.get_model(name_or_path)
    if not isinstance(model, EnhancementModel):
        raise NameMismatchError(
            f"--model: found {name_or_path}, a {type(model).__name__}, expected an EnhancementModel "
            "(torchface train enhancement makes one)"
        )
    return model


def enhance_animation(
    path: Path,
    model_name: str,
    out: Path,
    settings: EnhanceSettings = EnhanceSettings(),
    progress: Progress | None = None,
) -> Enhanced:
    """Reads, enhances, writes; see ``torchface enhance --help`` for the arguments.

    Writes ``enhanced.safetensors``, ``enhanced.glb``, ``comparison.mp4``, ``frames.csv``, ``summary.json``, and
    ``meshes/``, ``textures/`` and ``colors.safetensors`` where asked for or known;
    :func:`torchface.workflows.enhance.enhance_page.write_enhance_page` makes the report.
    """
    with within_job(out), made_folder(out / STATE) as state:
        return _enhance(path, model_name, out, state, settings, progress or silent)


def _enhance(
    path: Path, model_name: str, out: Path, state: Path, settings: EnhanceSettings, progress: Progress
) -> Enhanced:
    progress("reading the model")
    model = load_model(model_name)
    neutral = Mesh(model.neutral, model.faces)
    painted = None if settings.textures is None else _texels(settings.textures, model, model_name, settings)
    animation = read_coarse(path, neutral, settings.given, state, progress)
    _check_actor(animation, model)
    if animation.head is not None or settings.detail != 1:
        model = model.on_actor(model.neutral if animation.head is None else animation.head, settings.detail)
    given = settings.given
    named = {"rig": given.rig, "attachment": given.attachment, "pairs": given.pairs}
    key = content_key(_METHOD, input=path, **named, given=given, model=model, retime=settings.retime)
    if settings.retime:
        animation = retimed_animation(animation, model, progress)
    frames = enhance_frames(animation, model, out, state, key, progress)
    mesh = framed_model(model)
    products, notes = {"meshes, every frame": out / SEQUENCE}, list(animation.notes)
    if frames.colors is not None:
        products["vertex colours, every frame"] = frames.colors.path
    share = float(frames.outside.any(1).float().mean())
    if share > _MANY_OUTSIDE:
        notes.append(
            f"warning: {share:.0%} of the frames are unlike any the model has seen, so their detail is the nearest it "
            "has; a take of more expressions, or another actor's model, would do better"
        )
    if painted is not None:
        assert frames.colors is not None
        products["colours, an image a frame"] = _write_textures(frames.colors, mesh, painted, out / TEXTURES, progress)
    if settings.meshes != "none":
        products["meshes, a file a frame"] = _write_meshes(frames, mesh, out / MESHES, settings.meshes, progress)
    if settings.glb:
        products["animation"] = out / GLB
        notes.append(_write_glb(frames, mesh, animation.fps, out / GLB, settings.megabytes, progress))
    if settings.video:
        products["video"] = out / VIDEO
        _write_video(animation, model, frames, mesh, out / VIDEO, progress)
    done = Enhanced(animation, model, model_name, frames, mesh, products, tuple(notes))
    with all_or_none():
        _write_tables(done, out)
    return done


def _check_actor(animation: CoarseAnimation, model: EnhancementModel) -> None:
    """Raises ``AlignmentError`` where frames without a face at rest are another head: its shape would become dents."""
    residual = animation.residual
    if animation.kind != SAME_TOPOLOGY or animation.head is not None or residual is None or residual <= OWN_HEAD_MM:
        return
    rows = torch.linspace(0, animation.count - 1, min(_ASKED, animation.count)).long().unique().tolist()
    with torch.no_grad():
        outside = torch.cat([model.enhance(animation.read(row, row + 1)).outside for row in rows])
    share = float(outside.float().mean())
    if share > _ANOTHER:
        raise AlignmentError(
            f"{animation.path}: found {share:.0%} of the regions of {len(rows)} frames unlike any that the model has "
            f"seen, and the frame nearest to its neutral {residual:.1f} mm from it (root mean square): it seems to be "
            f"another person, whose head would become dents; expected the model's actor, at most {_ANOTHER:.0%}, or "
            "the person's own rig beside (--rig)"
        )


def _texels(path: Path, model: EnhancementModel, name: str, settings: EnhanceSettings) -> TexelMap:
    """Where the model's triangles lie in a mesh's texture coordinates."""
    if not has_colors(model):
        raise ValueRangeError(
            f"--textures: found the model {name}, which knows no colours, expected one of captured meshes with vertex "
            "colours"
        )
    mesh = load_mesh(path)
    if mesh.uvs is None or mesh.uv_faces is None:
        raise TopologyError(f"{path}: found a mesh without texture coordinates, expected some to write colours in")
    mesh.require_topology(Mesh(model.neutral, model.faces), path, "the model")
    return rasterise_uvs(mesh.uvs, mesh.uv_faces, settings.texture_size, settings.texture_size)


def _write_textures(colors: MeshSequence, mesh: Mesh, texels: TexelMap, folder: Path, progress: Progress) -> Path:
    make_folder(folder)
    for t in range(len(colors)):
        shades = texels.interpolate(colors.read(t, t + 1)[0].clamp(0, 1).double(), mesh.faces)
        save_image(texels.image(shades), folder / f"frame_{t:0{max(4, len(str(len(colors))))}d}.png")
        progress("writing textures", t + 1, len(colors))
    return folder


def _write_meshes(found: EnhancedFrames, mesh: Mesh, folder: Path, ending: str, progress: Progress) -> Path:
    """A file a frame; those that are newer than the frames themselves are an earlier run's, and right."""
    make_folder(folder)
    count, made = len(found.sequence), found.sequence.path.stat().st_mtime_ns
    digits = max(4, len(str(count)))
    for t in range(count):  # a file a frame
        path = folder / f"frame_{t:0{digits}d}.{ending}"
        if not (path.is_file() and path.stat().st_mtime_ns > made):
            colors = None if found.colors is None else found.colors.read(t, t + 1)[0].clamp(0, 1)
            save_mesh(Mesh(found.sequence.read(t, t + 1)[0], mesh.faces, colors=colors), path)
        progress("writing meshes", t + 1, count)
    return folder


def _write_glb(found: EnhancedFrames, mesh: Mesh, fps: float, path: Path, megabytes: float, progress: Progress) -> str:
    """Writes it, and says what it holds."""
    targets = animation_targets(found.sequence, mesh.vertices, megabytes, progress)
    progress("writing the animation")
    colors = None if found.colors is None else found.colors.read(0, 1)[0].clamp(0, 1)
    write_targets(targets, Mesh(mesh.vertices, mesh.faces, colors=colors), fps, path)
    size = path.stat().st_size / 1e6
    if targets.kind == "frames":
        return f"{path.name}: {size:.0f} MB, a sparse morph target a frame, exact"
    note = (
        f"{path.name}: {size:.0f} MB, {len(targets.deltas)} morph targets (principal components) for "
        f"{len(found.sequence)} frames, {targets.rms:.3f} mm from them (root mean square; worst frame "
        f"{targets.largest:.3f})"
    )
    if targets.rms > _BADLY_SHOWN_MM:
        note = f"warning: {note}; --glb-megabytes above {megabytes:g} would show more, {SEQUENCE} holds all"
    return note


def _write_video(
    animation: CoarseAnimation,
    model: EnhancementModel,
    found: EnhancedFrames,
    mesh: Mesh,
    path: Path,
    progress: Progress,
) -> None:
    count, step, drawn = drawn_frames(animation, model, found, mesh)

    def pictures():  # type: ignore[no-untyped-def]
        for number, picture in enumerate(drawn, 1):
            yield picture
            progress("drawing the video", number, count)

    write_video(pictures(), path, animation.fps / step)


def _write_tables(done: Enhanced, out: Path) -> None:
    names = done.model.regions.names
    distances, outside = done.frames.distances.tolist(), done.frames.outside.tolist()
    rows = [
        [str(t), *(f"{value:.5g}" for value in distances[t]), *(str(int(value)) for value in outside[t])]
        for t in range(len(distances))
    ]
    write_table(out / FRAMES, ["frame", *(f"distance_{n}" for n in names), *(f"outside_{n}" for n in names)], rows)
    summary = {
        "format": _FORMAT,
        "input": done.animation.path.name,
        "kind": done.animation.kind,
        "model": done.model_name,
        "frames": done.animation.count,
        "fps": done.animation.fps,
        "vertices": len(done.model.neutral),
        "residual_mm": done.animation.residual,
        "outside_share": done.outside_share,
        "outside_share_by_region": dict(zip(names, done.frames.outside.float().mean(0).tolist(), strict=True)),
        "median_distance_by_region": dict(zip(names, done.frames.distances.median(0).values.tolist(), strict=True)),
        "frames_enhanced": done.frames.enhanced,
        "seconds": done.frames.seconds,
        "notes": list(done.notes),
        "files": {what: path.name for what, path in done.products.items()},
    }
    write_json(out / SUMMARY, summary)


def spread_frames(done: Enhanced, count: int) -> list[int]:
    """Frames to show: those in which the result differs most from the neutral, spread over the animation."""
    total = done.animation.count
    rows = torch.linspace(0, total - 1, min(total, 4 * count)).round().long().unique()
    step = max(1, len(done.mesh.vertices) // 4000)
    moved = torch.stack(
        [done.frames.sequence.read(t, t + 1)[0, ::step] - done.mesh.vertices[::step] for t in rows.tolist()]
    )
    moved = (moved - moved.mean(1, keepdim=True)).norm(dim=-1).mean(-1)
    best = [part[moved[part].argmax()] for part in torch.arange(len(rows)).tensor_split(count) if len(part)]
    return [int(rows[i]) for i in best]

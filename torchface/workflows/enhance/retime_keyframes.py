"""A motion between two keyframes in the actor's timing, with the curve of each region."""

import re
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.enhancement import EnhancementModel
from torchface.enhancement.animation_retiming import at_moments
from torchface.errors import AlignmentError, TopologyError, ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.job_lock import job_lock
from torchface.files.whole_files import all_or_none
from torchface.io import MeshSequenceWriter, save_animation
from torchface.io.tables.csv_table import write_table
from torchface.mesh import Mesh
from torchface.number_checks import checked_count
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.viz.figures.curves import timing_curves
from torchface.viz.reports.report_page import Section, write_page
from torchface.workflows.animated_meshes import load_animated
from torchface.workflows.enhance.coarse_animation import check_finite, check_scale
from torchface.workflows.enhance.enhance_animation import load_model

SEQUENCE, GLB, CURVES = "retimed.safetensors", "retimed.glb", "timing.csv"
_FRAME = re.compile(r"(.+)@(\d+)")


@dataclass(frozen=True, eq=False)
class Retimed:
    """What came of two keyframes."""

    curves: Tensor  # how far each region has come in each frame, (R,T), 0 first and 1 last
    names: tuple[str, ...]
    fps: float
    products: dict[str, Path]

    def lines(self) -> list[str]:
        """For people to read."""
        frames = self.curves.shape[1]
        even = torch.linspace(0, 1, frames).to(self.curves)
        away = (self.curves - even).abs().amax(1)
        furthest = int(away.argmax())
        return [
            f"{frames} frames, {(frames - 1) / self.fps:.2f} s, {self.fps:g} a second; {len(self.names)} regions",
            f"the course is up to {float(away[furthest]):.0%} of the way from an even one ({self.names[furthest]})",
        ]


@dataclass(frozen=True)
class Keyframe:
    """A mesh, or a frame of an animation as ``FILE@NUMBER``."""

    path: Path
    frame: int | None = None  # its number, from 0; None for a file of one mesh
    rig: Path | None = None

    @staticmethod
    def parse(text: str, rig: Path | None = None) -> "Keyframe":
        """The keyframe that a text names."""
        found = None if Path(text).exists() else _FRAME.fullmatch(text)
        return Keyframe(Path(text), None, rig) if found is None else Keyframe(Path(found[1]), int(found[2]), rig)

    def vertices(self, model: EnhancementModel) -> Tensor:
        """(V,3) in the model's topology."""
        animated = load_animated(self.path, self.rig)
        hint = "; `torchface enhance` brings animations of other topologies to it"
        animated.neutral.require_topology(Mesh(model.neutral, model.faces), self.path, "the model", hint)
        if self.frame is None and animated.count != 1:
            raise ValueRangeError(
                f"{self.path}: found {animated.count} frames, expected which of them is the keyframe: {self.path}@0 to "
                f"{self.path}@{animated.count - 1}"
            )
        frame = self.frame or 0
        if frame >= animated.count:
            raise ValueRangeError(f"{self.path}: found no frame {frame}, expected 0 to {animated.count - 1}")
        vertices = animated.read(frame, frame + 1).float()
        check_finite(vertices, self.path, 1, frame)
        sizes = [float((points - points.mean(0)).square().mean().sqrt()) for points in (model.neutral, vertices[0])]
        check_scale(sizes[0] / max(sizes[1], 1e-9), self.path)
        return vertices[0]


def retime_keyframes(
    first: Keyframe,
    last: Keyframe,
    frames: int,
    model_name: str,
    out: Path,
    fps: float | None = None,
    extend: bool = False,
    progress: Progress | None = None,
) -> Retimed:
    """Times the motion between two keyframes as the actor moves, and writes it.

    Args:
        first, last: the motion's ends, in the model's topology.
        out: folder for ``retimed.safetensors``, which ``torchface enhance`` takes, ``retimed.glb`` (a morph target a
            region, exact), ``timing.csv`` and the page.
        extend: time it as the whole captured motion of which the keyframes meet a part.

    Source: Facial Performance Enhancement Using Dynamic Shape Space Analysis, section 6.2.
    """
    progress = progress or silent
    checked_count("--frames", frames, 2)
    if first.path == last.path and first.frame is last.frame is None:
        raise ValueRangeError(
            f"{first.path}: found the same file for both keyframes (--from and --to), expected two meshes or two of "
            "its frames, as in FILE@0 and FILE@12"
        )
    if first.path == last.path and (first.frame or 0) >= (last.frame or 0):
        numbers = f"{first.frame or 0} and {last.frame or 0}"
        raise ValueRangeError(f"{first.path}: found keyframes {numbers}, expected the first before the last")
    progress("reading the model")
    model = load_model(model_name)
    pair = torch.stack([first.vertices(model), last.vertices(model)])
    rate = model.fps if fps is None else fps
    progress("timing the motion")
    with torch.no_grad():
        try:
            curves = model.retime(pair, frames, rate, extend)
        except (TopologyError, AlignmentError) as error:
            raise type(error)(f"{first.path} or {last.path}: {error}") from None
    names = model.region_names
    shares = model.vertex_weights
    moved = at_moments(pair, curves.double(), shares)
    products = {"meshes, every frame": out / SEQUENCE, "animation": out / GLB, "curves": out / CURVES}
    text = (
        "How far each region has come on its way from the first keyframe to the last, beside linear blending. The "
        + ("whole captured motions" if extend else "parts of captured motions")
        + " that the keyframes meet give the course"
        + ("." if extend else "; --extend takes the whole of these motions.")
    )
    progress("writing the motion")
    with job_lock(out):
        key = content_key("retime/1", frames=moved)
        size = len(model.neutral)
        with MeshSequenceWriter(out / SEQUENCE, frames, size, model.faces, key=key, fps=rate) as writer:
            writer.append(moved)
        with all_or_none():  # not around the sequence, which notes at once how far it is
            # Regions' shares in a vertex add up to 1: a target a region gives every frame.
            deltas = shares.to(pair)[..., None] * (pair[1] - pair[0])
            targets = BlendshapeRig(Mesh(pair[0], model.faces), deltas, names)
            save_animation(targets, Take(rate, weights=Track(names, curves.T.float()[..., None])), out / GLB)
            rows = [[str(t), f"{t / rate:.6g}", *(f"{x:.6g}" for x in curves[:, t].tolist())] for t in range(frames)]
            write_table(out / CURVES, ["frame", "seconds", *names], rows)
            figure = timing_curves(curves, names, rate, "share of the way")
            title = f"{first.path.name} to {last.path.name} in {frames} frames"
            products["page"] = write_page(out, title, [Section("Timing", text, figures=[("timing.png", figure)])])
    return Retimed(curves, names, rate, products)

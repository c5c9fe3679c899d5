"""From a rig, a range-of-motion take and a first guess on disk to marker sites on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture import fit_attachment
from torchface.capture.markers import AttachmentFit, sites_by_shape
from torchface.errors import FileFormatError
from torchface.files import check_writable, make_folder
from torchface.io import load_rig
from torchface.io.picks import load_landmarks
from torchface.mesh import Mesh
from torchface.rendering.compositing import save_picture, sheet
from torchface.viz.marker_sites import error_rounds, site_views
from torchface.workflows.marker_input import AS_THEY_ARE, MarkerOptions, read_range_of_motion


@dataclass(frozen=True, eq=False)
class AttachReport:
    """What came of a range of motion.

    Args:
        fit: the sites and how they were found.
        moved: how far each marker's site is from the first guess, (M,), millimetres.
        warnings: what the user should know before they use the sites.
    """

    fit: AttachmentFit
    moved: Tensor
    warnings: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """For people to read."""
        first, last = self.fit.errors[0], self.fit.errors[-1]
        labels = self.fit.attachment.labels or ()
        worst = int(last.argmax())
        lines = [
            f"{len(labels)} markers over {len(self.fit.weights)} frames, {len(self.fit.errors)} rounds",
            f"sites moved by {float(self.moved.mean()):.1f} mm on average, by {float(self.moved.max()):.1f} mm at most",
            f"marker error: mean {float(first.mean()):.2f} mm at first, {float(last.mean()):.2f} mm in the end; "
            f"worst {labels[worst]}, {float(last[worst]):.2f} mm",
        ]
        if self.fit.standoff:
            lines.append(f"markers stand {self.fit.standoff:.2f} mm off the skin")
        return [*(f"warning: {warning}" for warning in self.warnings), *lines]


def load_sites(path: Path, mesh: Mesh, owner: str | Path = "the mesh") -> Attachment:
    """A first guess of marker sites: an attachment, or labelled vertices, as ``torchface pick`` writes both.

    Raises:
        FileFormatError: it is neither.
        TopologyError: it belongs to another mesh.
    """
    try:
        sites = Attachment.load(path)
    except FileFormatError as error:
        try:
            picked = load_landmarks(path)
        except FileFormatError:
            raise error from None
        picked.check(mesh)
        return Attachment.from_vertices(mesh, picked.vertices, picked.labels)
    sites.check(mesh, path, owner)
    return sites


def attach(
    rig: Path,
    rom: Path,
    out: Path,
    initial: Path | None = None,
    standoff: bool = False,
    picture: Path | None = None,
    part: str | None = None,
    progress: Callable[[str], None] | None = None,
    options: MarkerOptions = AS_THEY_ARE,
) -> AttachReport:
    """Reads, finds the sites, writes them; see ``torchface attach --help`` for the arguments.

    Raises:
        TorchfaceError: a file is broken, the take shows no motion, or the files do not fit each other.
    """
    say = progress or (lambda line: None)
    check_writable(out, picture)
    say("reading the rig")
    loaded = load_rig(rig, part=part)
    say("reading the range of motion")
    start = None if initial is None else load_sites(initial, loaded.neutral, rig)
    take, start, notes = read_range_of_motion(rom, start, options)
    if start is None:
        say("looking for the pose in which the markers lie on the face")
        start = sites_by_shape(loaded, take)
    say("finding where the markers sit")
    fit = fit_attachment(loaded, take, start, standoff)
    faces, vertices = loaded.neutral.faces, loaded.vertices
    before, after = start.on(faces, vertices), fit.attachment.on(faces, vertices)
    say("writing")
    make_folder(out.parent)
    fit.attachment.save(out)
    if picture is not None:
        save_picture(sheet([site_views(loaded.neutral, before, after), error_rounds(fit.errors)], 1), picture)
    return AttachReport(fit, torch.linalg.vector_norm(after - before, dim=1), tuple(notes))

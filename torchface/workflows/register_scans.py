"""From a template and scans on disk to registered meshes, a table and a contact sheet on disk."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import AlignmentError, FileFormatError, NameMismatchError
from torchface.files.job_lock import job_lock
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_mesh, load_rig
from torchface.io.rigs.ict_facekit import region
from torchface.mesh import Mesh, submesh
from torchface.modeling import HeadModel, MorphableModel
from torchface.progress import Progress, silent
from torchface.registration.corpus.register_corpus import CorpusReport, register_corpus
from torchface.registration.corpus.scan_record import CorpusEntry, read_distances
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import caption, save_rendered_image, sheet
from torchface.viz.figures.face_views import frame_face
from torchface.viz.figures.heat_maps import error_colors
from torchface.viz.figures.wireframe import lines_on_clay

CONTACT_SHEET = "contact_sheet.png"
_WIDTH, _HEIGHT = 144, 180
_TEXT = 11
_SKIPPED = 0.85
_MAX_DISTANCE = 1.0  # end of the distance maps' scale, millimetres
_KINDS = "HeadModel or MorphableModel"


@dataclass(frozen=True)
class RegisteredScans:
    """What a run left on disk: the report with its table, and the contact sheet of all scans."""

    report: CorpusReport
    contact_sheet: Path


def load_template(path: Path, part: str | None = None, unit: str | None = None) -> Mesh:
    """The mesh to bend: a mesh file, or the neutral of a rig (.glb, a folder of OBJ files, ICT-FaceKit's folder)."""
    if path.is_dir():
        return load_rig(path, unit, part).neutral
    mesh = load_mesh(path, unit)
    return mesh if part is None else submesh(mesh, region(mesh, part)).mesh


def register_scans(
    template: Path,
    scans: Sequence[Path],
    out: Path,
    landmarks: Path | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    part: str | None = None,
    unit: str | None = None,
    detector: str | Path | None = None,
    texture_size: int = 1024,
    model: str | Path | None = None,
    progress: Progress | None = None,
    finished: Callable[[CorpusEntry], None] | None = None,
) -> RegisteredScans:
    """Registers and draws; see ``torchface register --help`` for the arguments.

    Args:
        progress: called with each step and how far it is.
        finished: called with each scan's entry, as ``register_corpus`` does.

    Raises:
        AlignmentError: not one scan could be registered; table and contact sheet are written all the same.
        TorchfaceError: the template, ``out`` or a setting is of no use.
    """
    with job_lock(out):
        mesh = load_template(template, part)
        learned = None if model is None else load_shape_model(model)
        report = register_corpus(
            mesh,
            scans,
            out,
            jobs,
            cluster,
            progress,
            finished=finished,
            landmarks=landmarks,
            unit=unit,
            detector=None if detector is None else zoo.find(detector),
            model=learned,
            texture_size=texture_size,
        )
        picture = contact_sheet(report, mesh, progress)
        save_rendered_image(picture, report.out / CONTACT_SHEET)
    if not report.registered:
        raise AlignmentError(
            f"{out}: none of {len(report.entries)} scans could be registered, see {report.summary.name}; the first, "
            f"{report.entries[0].scan.name}: {report.entries[0].error}"
        )
    return RegisteredScans(report, report.out / CONTACT_SHEET)


def load_shape_model(name_or_path: str | Path) -> MorphableModel | HeadModel:
    """A model of heads by name or folder, see ``zoo.get_model``.

    Raises:
        NameMismatchError: there is none of this name, or it is of another kind.
    """
    model = zoo.get_model(name_or_path)
    if not isinstance(model, MorphableModel | HeadModel):
        raise NameMismatchError(
            f"model: found {name_or_path}, a {type(model).__name__}, expected a model of heads ({_KINDS})"
        )
    return model


def contact_sheet(report: CorpusReport, template: Mesh, progress: Progress | None = None) -> Tensor:
    """All registered faces from the template's front, their lines and distances to the scan; (3,H,W).

    Args:
        report: of the corpus.
        template: gives the direction that is the front: a scan may have any orientation.
        progress: called with each step and how far it is.
    """
    progress, cells = progress or silent, []
    for number, entry in enumerate(report.entries, 1):
        cells.append(_cell(entry, template, report.out))
        progress("drawing the contact sheet", number, len(report.entries))
    columns = max(4, round((len(cells) * 1.8) ** 0.5))
    return sheet(cells, min(columns, len(cells)))


def _cell(entry: CorpusEntry, template: Mesh, folder: Path) -> Tensor:
    name = entry.name if len(entry.name) <= 20 else f"{entry.name[:9]}..{entry.name[-9:]}"
    if entry.result is not None:
        try:
            mesh = load_mesh(entry.result)
            upright = in_place_of(mesh, template)
            camera = frame_face(upright, width=_WIDTH, height=_HEIGHT)
            views = [render(upright, camera, samples=1), lines_on_clay(upright, camera)]
            distances = read_distances(folder, entry.name)
            if distances is not None and len(distances) == len(upright.vertices):
                views.append(render(upright, camera, error_colors(distances, _MAX_DISTANCE, "turbo"), samples=1))
            caption_text = f"{entry.median_distance:.2f} mm on {entry.shown:.0%}"
            return caption(caption(sheet(views, 1), name, _TEXT), caption_text, _TEXT)
        except FileFormatError:  # somebody has deleted it meanwhile
            pass
    blank = torch.full((3, 3 * _HEIGHT, _WIDTH), _SKIPPED)
    return caption(caption(blank, name, _TEXT), "skipped", _TEXT)


def in_place_of(mesh: Mesh, template: Mesh, weights: Tensor | None = None) -> Mesh:
    """A mesh rotated and translated, without scaling, to where a template of the same topology is.

    Args:
        mesh: V vertices.
        template: V vertices.
        weights: how much each vertex counts, (V,); equal if absent.
    """
    own, other = mesh.vertices.double(), template.vertices.double()
    pose = similarity_transform(own[None], other[None], None if weights is None else weights[None], scale=False)
    return mesh.with_vertices(pose.apply(own[None])[0].to(mesh.vertices))

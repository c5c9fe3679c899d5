"""From a template and scans to registered meshes, a record each, a table and a contact sheet on disk."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchface import zoo
from torchface.errors import FileFormatError, NameMismatchError, ValueRangeError
from torchface.io import load_head_model_file, load_mesh, load_rig
from torchface.io.head_models.head_model_files import is_head_model_file
from torchface.io.length_units import millimetres_per
from torchface.io.rigs.ict_facekit import region
from torchface.mesh import Mesh, submesh
from torchface.modeling import HeadModel, MorphableModel, head_model_of
from torchface.progress import Progress
from torchface.registration import DEFAULT_SCHEDULE, Schedule
from torchface.registration.landmark_files import ENDINGS, landmark_file
from torchface.registration.model_fit import HasShape, LinearShape, ShapeModel, shape_model
from torchface.registration.scan_preparation import check_template
from torchface.workflows.batch.batch_items import SCAN_ENDINGS, ItemKind, find_items
from torchface.workflows.batch.outcomes import Outcome
from torchface.workflows.batch.run_batch import ONE_BY_ONE, BatchOptions, BatchReport, run_batch
from torchface.workflows.register.scan_job import ScanJob

SCANS = ItemKind("scan", "registered", SCAN_ENDINGS)
_KINDS = "HeadModel or MorphableModel"
_LARGEST_TEXTURE = 16384


def load_template_mesh(path: Path, part: str | None = None, unit: str | None = None) -> Mesh:
    """The mesh to bend: a mesh file, or the neutral of a rig (.glb, a folder of OBJ files, ICT-FaceKit's folder)."""
    if path.is_dir():
        return load_rig(path, unit, part).neutral
    mesh = load_mesh(path, unit)
    return mesh if part is None else submesh(mesh, region(mesh, part)).mesh


@dataclass(frozen=True, eq=False)
class ScanSettings:
    """What is known of scans, and how each is registered."""

    # A folder of landmark files named as the scans are, or the file of the only scan; see load_scan_landmarks. A scan
    # without one is registered without landmarks.
    landmarks: str | Path | None = None
    unit: str | None = None  # of the scans' files; if absent metres for glTF, millimetres for the others
    # schedule, texture_size: see register
    schedule: Schedule = DEFAULT_SCHEDULE
    texture_size: int = 1024
    # A landmark detector for the scans without landmarks, by name or folder; see zoo.get_model.
    detector: str | Path | None = None
    # Of faces in the template's topology, which each registration starts from; see register.
    model: ShapeModel | HasShape | None = None
    colors: bool = True  # whether the scans' colours are used, to find hair and as the results'

    def __post_init__(self) -> None:
        if self.unit is not None:
            millimetres_per(self.unit)
        if self.texture_size < 0 or self.texture_size > _LARGEST_TEXTURE:
            raise ValueRangeError(f"texture_size: found {self.texture_size}, expected 0 to {_LARGEST_TEXTURE}")


def register_scans(
    template: Mesh,
    scans: Sequence[str | Path],
    out: str | Path,
    settings: ScanSettings = ScanSettings(),
    options: BatchOptions = ONE_BY_ONE,
    progress: Progress | None = None,
    finished: Callable[[Outcome], None] | None = None,
) -> BatchReport:
    """Registers scans one by one into a folder: ``NAME.glb`` and ``records/NAME.json`` of each, a table and a sheet.

    Args:
        scans: files and folders; a folder stands for the scans in it, sorted by name.
        out: the folder to write into, made where it is missing; not one that holds scans or landmarks.
        progress: called with how many scans are done, and of how many; those of an earlier run count at once.
    """
    landmarks, detector, model = settings.landmarks, settings.detector, settings.model
    check_template(template)
    items = find_items(scans, SCANS)
    one = landmarks is not None and len(items.items) == 1 and Path(landmarks).is_file()
    marks = None if landmarks is None else Path(landmarks).resolve() if one else _folder("landmarks", landmarks)
    if marks is not None and items.items and not any(landmark_file(marks, item.path) for item in items.items):
        wanted = " or ".join(f"{items.items[0].path.stem}{ending}" for ending in ENDINGS)
        raise FileFormatError(
            f"landmarks: found no file of a scan's name in {landmarks}, expected one such as {wanted}"
        )
    if marks == Path(out).resolve():
        raise ValueRangeError(f"out: found {out}, which holds landmarks; expected another folder")
    job = ScanJob(
        template,
        settings.schedule,
        settings.texture_size,
        marks,
        settings.unit,
        None if detector is None else _folder("detector", zoo.find(detector)),
        None if model is None else LinearShape.of(shape_model(model, template)),
        settings.colors,
    )
    return run_batch(job, SCANS, items, out, options, progress, finished)


def load_shape_model(name_or_path: str | Path) -> MorphableModel | HeadModel:
    """A model of heads by name or folder, see ``zoo.get_model``; or a file of others, of its own topology."""
    if is_head_model_file(name_or_path):
        return head_model_of(load_head_model_file(name_or_path))
    model = zoo.get_model(name_or_path)
    if not isinstance(model, MorphableModel | HeadModel):
        raise NameMismatchError(
            f"model: found {name_or_path}, a {type(model).__name__}, expected a model of heads ({_KINDS})"
        )
    return model


def _folder(what: str, path: str | Path) -> Path:
    folder = Path(path).resolve()
    if not folder.is_dir():
        raise FileFormatError(f"{what}: found no folder {path}, expected one")
    return folder

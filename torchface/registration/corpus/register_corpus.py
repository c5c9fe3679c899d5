"""Many scans registered to one template: one at a time, in processes, or on a cluster; killed, it continues."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from torchface.errors import FileFormatError, ValueRangeError
from torchface.files.content_keys import content_key
from torchface.files.job_lock import within_job
from torchface.io.length_units import millimetres_per
from torchface.io.mesh_files import MESH_ENDINGS
from torchface.io.meshes.named_files import named_files
from torchface.mesh import Mesh
from torchface.progress import Progress, silent
from torchface.registration.corpus.processes import in_processes
from torchface.registration.corpus.ray_cluster import import_ray, on_cluster
from torchface.registration.corpus.scan_job import CorpusJob
from torchface.registration.corpus.scan_record import CorpusEntry, CorpusTask, finished_entry, write_summary
from torchface.registration.landmark_files import landmark_file
from torchface.registration.model_fit import HasShape, LinearShape, ShapeModel, shape_model
from torchface.registration.nonrigid.schedule import DEFAULT_SCHEDULE, Schedule
from torchface.registration.scan_preparation import check_template

SCAN_ENDINGS = (*MESH_ENDINGS, ".glb", ".gltf")
SUMMARY = "summary.csv"
_METHOD = "register/2"
"""What results are made with; another number where the same scan and settings come to give another result."""


@dataclass(frozen=True)
class CorpusReport:
    """What became of a corpus.

    Args:
        entries: one a scan, in the order given.
        out: the folder of results and records.
        summary: the table, CSV.
    """

    entries: tuple[CorpusEntry, ...]
    out: Path
    summary: Path

    @property
    def registered(self) -> tuple[CorpusEntry, ...]:
        """Those with a result."""
        return tuple(entry for entry in self.entries if entry.registered)

    @property
    def skipped(self) -> tuple[CorpusEntry, ...]:
        """Those without."""
        return tuple(entry for entry in self.entries if not entry.registered)


def register_corpus(
    template: Mesh,
    scans: Sequence[str | Path],
    out: str | Path,
    jobs: int = 1,
    cluster: str | None = None,
    progress: Progress | None = None,
    *,
    finished: Callable[[CorpusEntry], None] | None = None,
    landmarks: str | Path | None = None,
    unit: str | None = None,
    schedule: Schedule = DEFAULT_SCHEDULE,
    texture_size: int = 1024,
    detector: str | Path | None = None,
    model: ShapeModel | HasShape | None = None,
) -> CorpusReport:
    """Registers scans one by one into a folder: ``NAME.glb`` and a record ``NAME.json`` for each, and ``summary.csv``.

    A scan that cannot be registered is named in report, record and table, and the others go on. Results are complete
    files and a record comes after its result: a run that was killed, started again, takes what is finished and goes
    on with the rest. A scan is registered anew when the content of its files (those beside it of the same name and
    those it names included), its landmarks, the template with all annotations, the settings, the model or the version
    of this package has changed, when its result is no longer what was written, or its record has been deleted; one
    that failed for another reason than what it holds (a process that died) is tried again.

    Args:
        template: a face, millimetres.
        scans: files and folders; a folder stands for the scans in it, sorted by name.
        out: the folder to write into, made where it is missing; not one that holds scans or landmarks.
        jobs: how many processes of one thread each; 1 registers in this one, with all its threads. A script that
            asks for more must call under ``if __name__ == "__main__"``.
        cluster: the address of a Ray cluster, or ``"auto"`` on one of its machines, instead of ``jobs``; scans and
            ``out`` must lie where all its machines see them.
        progress: called with how many scans are done, and of how many; those of an earlier run count at once.
        finished: called with each scan's entry, those of an earlier run first.
        landmarks: a folder of landmark files named as the scans are; see ``load_scan_landmarks``. A scan without one
            is registered without landmarks.
        unit: of the scans' files; if absent metres for glTF, millimetres for the others.
        schedule, texture_size: see ``register``.
        detector: the folder of a landmark detector for the scans without landmarks; see ``load_detector``.
        model: of faces in the template's topology, which each registration starts from; see ``register``.

    Returns:
        ``CorpusReport(entries, out, summary)``.

    Raises:
        FileFormatError: no scan is named or found, or ``out`` cannot be written to.
        TopologyError, ValueRangeError: a template that nothing can be registered with.
        ValueRangeError: settings that make no sense, another run writing into ``out``, or no cluster there.
        MissingExtraError: a cluster is asked for and ray is not installed.
    """
    if jobs < 1:
        raise ValueRangeError(f"jobs: found {jobs}, expected at least 1")
    if unit is not None:
        millimetres_per(unit)
    if texture_size < 0 or texture_size > 16384:
        raise ValueRangeError(f"texture_size: found {texture_size}, expected 0 to 16384")
    if cluster is not None:
        import_ray()
    check_template(template)
    files = find_scans(scans)
    folder = Path(out).resolve()
    marks = None if landmarks is None else _folder("landmarks", landmarks)
    _check_apart(folder, files, marks)
    job = CorpusJob(
        template,
        folder,
        schedule,
        texture_size,
        unit,
        None if detector is None else _folder("detector", detector),
        None if model is None else LinearShape.of(shape_model(model, template)),
    )
    tasks = corpus_tasks(job, files, marks)
    progress = progress or silent
    with within_job(folder):
        kept = [entry for task in tasks if (entry := finished_entry(task, job.out)) is not None]
        entries = {entry.name: entry for entry in kept}
        progress("registering scans", len(entries), len(tasks))
        todo = [task for task in tasks if task.name not in entries]
        for entry in chain(kept, _registered(job, todo, jobs, cluster)):
            entries[entry.name] = entry
            if finished is not None:
                finished(entry)
            if not entry.reused:
                progress("registering scans", len(entries), len(tasks))
        ordered = tuple(entries[task.name] for task in tasks)
        write_summary(ordered, folder / SUMMARY)
    return CorpusReport(ordered, folder, folder / SUMMARY)


def find_scans(scans: Sequence[str | Path]) -> list[Path]:
    """Files as named, and for each folder the scans in it, sorted by name; absolute, none twice.

    Raises:
        FileFormatError: nothing is named, or a folder holds no scan.
    """
    found: dict[Path, None] = {}
    for one in map(Path, scans):
        if not one.is_dir():
            found[one.resolve()] = None
            continue
        inside = sorted(path for path in one.iterdir() if path.suffix.lower() in SCAN_ENDINGS and path.is_file())
        if not inside:
            raise FileFormatError(f"{one}: found no scan in the folder, expected files {', '.join(SCAN_ENDINGS)}")
        found |= dict.fromkeys(path.resolve() for path in inside)
    if not found:
        raise FileFormatError("scans: found none named, expected files or folders")
    return list(found)


def _registered(job: CorpusJob, todo: list[CorpusTask], jobs: int, cluster: str | None) -> Iterable[CorpusEntry]:
    if not todo:
        return []
    if cluster is not None:
        return on_cluster(job, todo, cluster)
    return in_processes(job, todo, jobs) if jobs > 1 else map(job.run, todo)


def corpus_tasks(job: CorpusJob, files: list[Path], marks: Path | None) -> list[CorpusTask]:
    """What is to be done: a task a scan, with a name and a key of everything that its result depends on.

    Args:
        job: what all scans share.
        files: of the scans, absolute.
        marks: the folder of landmarks, where there is one.
    """
    shared = content_key(
        _METHOD,
        template=job.template,
        schedule=job.schedule,
        texture_size=job.texture_size,
        unit=job.unit,
        detector=job.detector,
        model=job.model,
    )
    beside = {folder: _named(folder) for folder in {path.parent for path in files}}
    tasks = []
    for name, scan in zip(_names(files), files, strict=True):
        points = None if marks is None else landmark_file(marks, scan)
        own = sorted({scan, *beside[scan.parent].get(scan.stem, []), *named_files(scan)})
        key = content_key(
            _METHOD,
            shared=shared,
            scan=str(scan),
            files={str(path): path for path in own},
            landmark_file=None if points is None else points.name,
            landmarks=points,
        )
        tasks.append(CorpusTask(name, scan, points, key))
    return tasks


def _names(files: list[Path]) -> list[str]:
    """A name each, none twice: the file's, with its folder's or its ending's where others have the same."""
    ways: tuple[Callable[[Path], str], ...] = (
        lambda path: path.stem,
        lambda path: f"{path.parent.name}_{path.stem}",
        lambda path: f"{path.parent.name}_{path.stem}_{path.suffix[1:]}",
        lambda path: f"{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}",
    )
    names = [ways[0](path) for path in files]
    for way in ways[1:]:
        # File systems may not tell upper from lower case.
        count = Counter(name.lower() for name in names)
        names = [way(path) if count[name.lower()] > 1 else name for name, path in zip(names, files, strict=True)]
    return names


def _named(folder: Path) -> dict[str, list[Path]]:
    """The files of a folder by the part of their name before the first dot that a scan of the folder has whole."""
    found: dict[str, list[Path]] = {}
    if folder.is_dir():
        for path in sorted(folder.iterdir()):
            parts = path.name.split(".")
            for end in range(1, len(parts)):
                found.setdefault(".".join(parts[:end]), []).append(path)
    return found


def _folder(what: str, path: str | Path) -> Path:
    folder = Path(path).resolve()
    if not folder.is_dir():
        raise FileFormatError(f"{what}: found no folder {path}, expected one")
    return folder


def _check_apart(folder: Path, files: list[Path], marks: Path | None) -> None:
    """Results and records must not fall onto scans or landmarks of the same name."""
    if marks == folder or any(path.parent == folder for path in files):
        raise ValueRangeError(f"out: found {folder}, which holds scans or landmarks; expected another folder")

"""One scan of many, registered from file to file."""

from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface import zoo
from torchface.files.content_keys import content_key
from torchface.geometry.similarity import similarity_transform
from torchface.io import load_mesh, save_mesh
from torchface.io.meshes.named_files import named_files
from torchface.landmarks import AutomaticLandmarks, UVLandmarkDetector
from torchface.mesh import Annotations, Mesh
from torchface.modeling.rigging.part_placement import with_placed_parts
from torchface.registration import Registration, Schedule, in_place_of, load_scan_landmarks, register
from torchface.registration.landmark_files import landmark_file
from torchface.registration.model_fit import LinearShape
from torchface.registration.own_topology import as_it_is
from torchface.registration.scan_colors import has_colors, without_colors
from torchface.registration.scan_registration import NO_COLORS
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import sheet
from torchface.rig import BlendshapeRig
from torchface.viz import error_colors, frame_face
from torchface.viz.figures.landmark_dots import with_dots
from torchface.viz.figures.registration_views import lines_on_clay
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.batch.contact_sheet import HEIGHT, WIDTH
from torchface.workflows.batch.outcomes import RESULT, Made, word_of
from torchface.workflows.register.scan_expression import front_view, shown_expression

_METHOD = "register/9"
"""What results are made with; another number where the same scan and settings come to give another result."""
_MAX_DISTANCE = 1.0  # end of the distance maps' scale, millimetres


@dataclass(frozen=True, eq=False)
class ScanJob:
    """What all scans share."""

    template: Mesh  # bent onto each
    # schedule, texture_size: see register
    schedule: Schedule
    texture_size: int
    landmarks: Path | None = None  # a folder of landmark files named as the scans
    unit: str | None = None  # of the scans' files; each format's own if absent
    detector: Path | None = None  # the folder of a landmark detector for the scans without landmarks
    model: LinearShape | None = None  # of faces, which each registration starts from
    colors: bool = True  # whether the scans' colours are used

    def key(self, item: BatchItem) -> str:
        """A key of everything that a scan's result depends on: its files (those beside it of the same name and those
        it names included), its landmarks, the template with all annotations, the settings, model and version."""
        points = None if self.landmarks is None else landmark_file(self.landmarks, item.path)
        own = sorted({item.path, *self._beside(item.path), *named_files(item.path)})
        return content_key(
            _METHOD,
            shared=self._shared_key,
            scan=str(item.path),
            files={str(path): path for path in own},
            landmark_file=None if points is None else points.name,
            landmarks=points,
        )

    def run(self, item: BatchItem, out: Path) -> Made:
        """Registers a scan and writes ``NAME.glb``."""
        points = None if self.landmarks is None else landmark_file(self.landmarks, item.path)
        registration, count = self._registered(item.path, points)
        record, result = registration.record, out / f"{item.name}.glb"
        save_mesh(registration.mesh, result)
        stages = [asdict(stage) for stage in record.stages]
        for stage in stages:
            del stage["energies"]
        return Made(
            (result,),
            {
                RESULT: word_of(record.verdict()),
                "median_mm": record.median_distance,
                "matched": record.matched,
                "start": record.start,
                "start_mm": record.start_distance,
                "landmarks": count,
                "p95_mm": record.far_distance,
                "shown": record.shown,
                "covered": record.covered,
                "stretch": record.stretch,
                "slid_mm": record.slid,
            },
            f"{record.median_distance:.2f} mm on {record.shown:.0%}",
            record.notes,
            self._picture(registration),
            {"landmark_file": None if points is None else str(points), "stages": stages},
        )

    def _registered(self, scan: Path, points: Path | None) -> tuple[Registration, int]:
        """The registration, and how many landmarks were given."""
        mesh, landmarks = load_mesh(scan, self.unit), None
        left_out = not self.colors and has_colors(mesh)
        mesh = without_colors(mesh) if left_out else mesh
        if mesh.fingerprint() == self.template.fingerprint():
            return as_it_is(self.template, mesh), 0
        if points is not None:
            landmarks = load_scan_landmarks(points, self.template, scan, self.unit)
        registration = register(
            self.template,
            mesh,
            landmarks,
            detector=self._detector if landmarks is None else None,
            model=self.model,
            schedule=self.schedule,
            texture_size=self.texture_size,
        )
        if left_out:
            notes = tuple(note for note in registration.record.notes if note != NO_COLORS)
            registration = replace(registration, record=replace(registration.record, notes=notes))
        view = front_view(mesh, registration, self.template)
        if view is not None and (seen := shown_expression(view)):
            # Scans of expressions are registered too, so this is no warning.
            said = f"not at rest, as the landmark network sees it from the front: {seen}"
            record = registration.record
            registration = replace(registration, record=replace(record, notes=(*record.notes, said)))
        shapeless = BlendshapeRig(self.template, torch.zeros(0, len(self.template.vertices), 3), ())
        return with_placed_parts(shapeless, registration), 0 if landmarks is None else len(landmarks[0])

    def _picture(self, registration: Registration) -> Tensor:
        """The face with landmarks (the scan's green, its own red), its lines, its distances to the scan; (3,H,W)."""
        upright = in_place_of(registration.mesh, self.template)  # a scan may have any orientation
        camera = frame_face(upright, width=WIDTH, height=HEIGHT)
        seen = registration.distance.masked_fill(~registration.matched, torch.nan)
        distances = error_colors(seen.to(upright.vertices), _MAX_DISTANCE, "turbo")
        face = render(upright, camera, samples=1)
        if registration.landmarks is not None:
            ids, points = registration.landmarks
            own, turned = (mesh.vertices.double()[None] for mesh in (registration.mesh, upright))
            points = similarity_transform(own, turned, scale=False).apply(points[None].to(own))
            pixels = (camera.project(one) for one in (points[0], turned[0, ids]))
            face = with_dots((255 * face.clamp(0, 1)).byte(), *pixels).float() / 255
        return sheet([face, lines_on_clay(upright, camera), render(upright, camera, distances, samples=1)], 1)

    @cached_property
    def _shared_key(self) -> str:
        return content_key(
            _METHOD,
            template=self.template,
            schedule=self.schedule,
            texture_size=self.texture_size,
            unit=self.unit,
            detector=self.detector,
            model=self.model,
            colors=self.colors,
        )

    def _beside(self, scan: Path) -> list[Path]:
        """The files of the scan's folder with its name and another ending; each folder is listed once."""
        if scan.parent not in self._listed:
            self._listed[scan.parent] = _by_name(scan.parent)
        return self._listed[scan.parent].get(scan.stem, [])

    @cached_property
    def _listed(self) -> dict[Path, dict[str, list[Path]]]:
        return {}

    @cached_property
    def _detector(self) -> AutomaticLandmarks | None:
        if self.detector is None:
            return None
        return AutomaticLandmarks(zoo.get_model(self.detector, UVLandmarkDetector), self.template)

    def __reduce__(self) -> tuple[Any, ...]:
        # Tensors would travel through shared memory, which containers keep small; arrays are copied.
        settings = (self.schedule, self.texture_size, self.landmarks, self.unit, self.detector, None, self.colors)
        model = None if self.model is None else (self.model.mean.numpy(), self.model.modes.numpy())
        return _arrived, (_packed(self.template), model, *settings)


def _by_name(folder: Path) -> dict[str, list[Path]]:
    """The files of a folder by each part of their names that ends before a dot."""
    paths: dict[str, list[Path]] = {}
    if folder.is_dir():
        for path in sorted(folder.iterdir()):
            parts = path.name.split(".")
            for end in range(1, len(parts)):
                paths.setdefault(".".join(parts[:end]), []).append(path)
    return paths


def _packed(mesh: Mesh) -> dict[str, Any]:
    arrays: dict[str, Any] = {
        f.name: value.detach().cpu().numpy() for f in fields(mesh) if isinstance(value := getattr(mesh, f.name), Tensor)
    }
    notes = mesh.annotations
    if notes is not None:
        arrays["annotations"] = {
            "regions": {name: mask.cpu().numpy() for name, mask in notes.regions.items()},
            **{
                name: value.cpu().numpy()
                for name in ("landmarks", "mirror", "contacts")
                if (value := getattr(notes, name)) is not None
            },
        }
    return arrays


def _arrived(arrays: dict[str, Any], model: tuple[np.ndarray, np.ndarray] | None, *settings: Any) -> ScanJob:
    def tensors(found: dict[str, Any]) -> dict[str, Any]:
        return {
            name: tensors(value) if isinstance(value, dict) else torch.from_numpy(np.array(value))
            for name, value in found.items()
        }

    mesh = tensors(arrays)
    if "annotations" in mesh:
        mesh["annotations"] = Annotations(**mesh["annotations"])
    shape = None if model is None else LinearShape(*(torch.from_numpy(np.array(part)) for part in model))
    return replace(ScanJob(Mesh(**mesh), *settings), model=shape)

"""One scan of a corpus, from file to file: what every engine runs, here, in another process, or on another machine."""

from __future__ import annotations

import time
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchface.errors import MissingExtraError, TorchfaceError
from torchface.io import load_mesh, save_mesh
from torchface.landmarks.scans.detector_files import load_detector
from torchface.landmarks.scans.landmark_pairs import AutomaticLandmarks
from torchface.mesh import Annotations, Mesh
from torchface.registration.corpus.scan_record import CorpusEntry, CorpusTask, write_record
from torchface.registration.landmark_files import load_scan_landmarks
from torchface.registration.model_fit import LinearShape
from torchface.registration.nonrigid.schedule import Schedule
from torchface.registration.scan_registration import Registration, register


@dataclass(frozen=True, eq=False)
class CorpusJob:
    """What all scans of a corpus share.

    Args:
        template: bent onto each.
        out: the folder of results and records.
        schedule, texture_size: see ``register``.
        unit: of the scans' files; each format's own if absent.
        detector: the folder of a landmark detector for the scans without landmarks.
        model: of faces, which each registration starts from.
    """

    template: Mesh
    out: Path
    schedule: Schedule
    texture_size: int
    unit: str | None = None
    detector: Path | None = None
    model: LinearShape | None = None

    def run(self, task: CorpusTask) -> CorpusEntry:
        """Registers a scan and writes result and record; whatever is wrong with the scan is reported, not raised."""
        begin = time.perf_counter()
        entry = CorpusEntry(task.name, task.scan)
        try:
            registration, landmarks = self._registered(task)
            found = registration.record
            entry = replace(
                entry,
                result=self.out / f"{task.name}.glb",
                start=found.start,
                start_distance=found.start_distance,
                median_distance=found.median_distance,
                matched=found.matched,
                far_distance=found.far_distance,
                shown=found.shown,
                covered=found.covered,
                stretch=found.stretch,
                slid=found.slid,
                landmarks=landmarks,
                notes=found.notes,
            )
        except TorchfaceError as error:
            # The same file would give the same error: the record keeps a later run from trying again.
            entry = replace(entry, error=str(error), lasting=not isinstance(error, MissingExtraError))
        except Exception as error:  # one scan must not stop the others, whatever it has come upon
            entry = replace(entry, error=f"{type(error).__name__}: {error}")
        entry = replace(entry, seconds=time.perf_counter() - begin)
        try:
            if entry.result is not None:
                save_mesh(registration.mesh, entry.result)
                seen = registration.distance.masked_fill(~registration.matched, torch.nan)
                write_record(entry, task, found, self.out, seen)
            elif entry.lasting:
                write_record(entry, task, None, self.out)
        except (TorchfaceError, OSError) as error:
            return CorpusEntry(task.name, task.scan, error=str(error), seconds=entry.seconds)
        return entry

    def _registered(self, task: CorpusTask) -> tuple[Registration, int]:
        """The registration, and how many landmarks were given."""
        scan = load_mesh(task.scan, self.unit)
        landmarks = None
        if task.landmarks is not None:
            landmarks = load_scan_landmarks(task.landmarks, self.template, task.scan, self.unit)
        registration = register(
            self.template,
            scan,
            landmarks,
            detector=self._detector if landmarks is None else None,
            model=self.model,
            schedule=self.schedule,
            texture_size=self.texture_size,
        )
        return registration, 0 if landmarks is None else len(landmarks[0])

    @cached_property
    def _detector(self) -> AutomaticLandmarks | None:
        return None if self.detector is None else AutomaticLandmarks(load_detector(self.detector), self.template)

    def __reduce__(self) -> tuple[Any, ...]:
        # Tensors would travel through shared memory, which containers keep small; arrays are copied.
        settings = (self.out, self.schedule, self.texture_size, self.unit, self.detector)
        model = None if self.model is None else (self.model.mean.numpy(), self.model.modes.numpy())
        return _arrived, (_packed(self.template), model, *settings)


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


def _arrived(arrays: dict[str, Any], model: tuple[np.ndarray, np.ndarray] | None, *settings: Any) -> CorpusJob:
    def tensors(found: dict[str, Any]) -> dict[str, Any]:
        return {
            name: tensors(value) if isinstance(value, dict) else torch.from_numpy(np.array(value))
            for name, value in found.items()
        }

    mesh = tensors(arrays)
    if "annotations" in mesh:
        mesh["annotations"] = Annotations(**mesh["annotations"])
    shape = None if model is None else LinearShape(*(torch.from_numpy(np.array(part)) for part in model))
    return replace(CorpusJob(Mesh(**mesh), *settings), model=shape)

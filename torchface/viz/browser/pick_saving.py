"""Picks into files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from torchface.errors import ValueRangeError
from torchface.files.whole_files import all_or_none, made_folder
from torchface.io import save_mesh, save_rig
from torchface.io.landmarks.picks import save_correspondences, save_landmarks
from torchface.mesh import Annotations, Mesh
from torchface.rig import BlendshapeRig
from torchface.viz.browser.pick_session import PickSession


def save_picks(session: PickSession, folder: str | Path, rig: BlendshapeRig | None = None) -> list[Path]:
    """Writes everything that is picked.

    ==================== =======================================================================================
    landmarks.json       landmark vertices, :func:`torchface.io.landmarks.picks.load_landmarks`
    annotated.glb        the mesh, or ``rig``, with the landmarks as annotations; once all of the set are picked
    attachment.json      marker sites, ``Attachment.load``
    correspondences.json pairs of template and scan, :func:`torchface.io.landmarks.picks.load_correspondences`
    ==================== =======================================================================================

    Args:
        session: the picks.
        folder: where to; made if missing.
        rig: the rig whose neutral the session's mesh is, so that its shapes are kept.

    Returns:
        The files written.
    """
    folder, picks = Path(folder), session.picks
    picked = [vertex for vertex in picks.landmarks if vertex is not None]
    if not (picked or picks.markers or picks.pairs):
        raise ValueRangeError("picks: found none, expected a landmark, a marker or a correspondence to save")
    with made_folder(folder), all_or_none():
        return _write(session, folder, rig)


def _write(session: PickSession, folder: Path, rig: BlendshapeRig | None) -> list[Path]:
    picks, written = session.picks, list[Path]()
    picked = [vertex for vertex in picks.landmarks if vertex is not None]
    if picked:
        save_landmarks(session.landmarks(), folder / "landmarks.json")
        written.append(folder / "landmarks.json")
    if len(picked) == len(picks.landmarks):
        _save_annotated(annotated(session), rig, folder / "annotated.glb")
        written.append(folder / "annotated.glb")
    if picks.markers:
        session.attachment().save(folder / "attachment.json")
        written.append(folder / "attachment.json")
    if picks.pairs:
        save_correspondences(session.correspondences(), folder / "correspondences.json")
        written.append(folder / "correspondences.json")
    return written


def annotated(session: PickSession) -> Mesh:
    """The session's mesh with its landmarks as annotations, everything else kept.

    Raises:
        ValueRangeError: a landmark is missing.
    """
    vertices = session.picks.landmarks
    missing = [name for name, vertex in zip(session.landmark_set.names, vertices, strict=True) if vertex is None]
    if missing:
        raise ValueRangeError(
            f"landmarks: found {len(vertices) - len(missing)} of {len(vertices)} picked, expected all; "
            f"missing are {', '.join(missing[:5])}"
        )
    before = session.mesh.annotations or Annotations()
    return replace(session.mesh, annotations=replace(before, landmarks=torch.tensor(vertices, dtype=torch.int64)))


def _save_annotated(mesh: Mesh, rig: BlendshapeRig | None, path: Path) -> None:
    if rig is None:
        save_mesh(mesh, path)
    else:
        save_rig(BlendshapeRig(mesh, rig.deltas.cpu(), rig.names, rig.correctives), path)

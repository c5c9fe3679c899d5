"""Landmark files beside scans, read as what ``register`` takes."""

from pathlib import Path

import torch

from torchface.errors import FileFormatError, ShapeError, ValueRangeError
from torchface.files.documents import read_json
from torchface.io import load_correspondences, load_landmark_points
from torchface.io.length_units import millimetres_per
from torchface.io.rig_files import GLTF_ENDINGS
from torchface.io.usd.usd_writing import USD_ENDINGS
from torchface.mesh import Mesh
from torchface.registration.scan_preparation import Landmarks

ENDINGS = (".ljson", ".json", ".pts")
_MAX_FILE = 16 * 2**20


def landmark_file(folder: Path, scan: Path) -> Path | None:
    """The file of a scan's landmarks: its name with ``.ljson``, ``.json`` or ``.pts``, or the file that is given in
    place of a folder; None where there is none."""
    if folder.is_file():
        return folder
    return next((path for ending in ENDINGS if (path := folder / f"{scan.stem}{ending}").is_file()), None)


def load_scan_landmarks(path: str | Path, template: Mesh, scan: str | Path, unit: str | None = None) -> Landmarks:
    """Template vertex ids (L,) and scan points (L,3), millimetres.

    Args:
        path: correspondences as ``torchface pick`` saves them (JSON, made for this template); or points only
            (LJSON, or PTS of three numbers a row), in the order of the template's annotated landmarks, in the scan's
            unit.
        template: what will be registered.
        scan: the scan's file; metres where it is glTF.
        unit: of the scan's file, where it is another.

    Raises:
        FileFormatError: a broken file, or points in an image.
        TopologyError: correspondences of another template.
        ValueRangeError: points only, and a template without annotated landmarks; or beside a USD file, without a unit.
        ShapeError: another number of points than the template has landmarks.

    Example:
        >>> from torchface.io import Correspondences, save_correspondences
        >>> from torchface.synthetic import neutral_head
        >>> template = neutral_head(texture=False)
        >>> nose = template.landmarks[[30]]
        >>> save_correspondences(Correspondences(nose, torch.tensor([[1.0, 2, 3]]), ("nose",)), "picks.json")
        >>> vertices, points = load_scan_landmarks("picks.json", template, "scan.obj")
        >>> torch.equal(vertices, nose), points.tolist()
        (True, [[1.0, 2.0, 3.0]])
    """
    path = Path(path)
    if _is_correspondences(path):
        pairs = load_correspondences(path)
        pairs.check(template)
        return pairs.vertices, pairs.points
    loaded = load_landmark_points(path)
    if loaded.points.shape[1] != 3:
        raise FileFormatError(f"{path}: found points in an image, two numbers each; expected places on the scan")
    if template.annotations is None or template.annotations.landmarks is None:
        raise ValueRangeError(
            f"{path}: found points without vertices and a template without annotated landmarks; expected "
            "correspondences, or an annotated template (torchface pick makes both)"
        )
    ids = template.annotations.landmarks.cpu()
    points = loaded.ibug() if loaded.groups and len(ids) == 68 else loaded.points
    if len(points) != len(ids):
        raise ShapeError(f"{path}: found {len(points)} points, expected the template's {len(ids)} landmarks")
    suffix = Path(scan).suffix.lower()
    if unit is None and suffix in USD_ENDINGS:
        raise ValueRangeError(f"{path}: found points beside a USD file, expected their unit (mm, cm, m, in; --unit)")
    per_unit = millimetres_per(unit or ("m" if suffix in GLTF_ENDINGS else "mm"))
    return ids, points * torch.tensor(per_unit, dtype=points.dtype)


def _is_correspondences(path: Path) -> bool:
    if path.suffix.lower() != ".json":
        return False
    document = read_json(path, max_bytes=_MAX_FILE).found
    return isinstance(document, dict) and "format" in document

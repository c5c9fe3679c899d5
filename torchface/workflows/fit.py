"""From photographs and a head model on disk to a personal rig on disk, with the fit drawn over each photograph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchface import zoo
from torchface.errors import FileFormatError, NameMismatchError, ShapeError, TopologyError
from torchface.geometry.calibration import CameraCalibration
from torchface.geometry.camera import Camera
from torchface.io import load_rig, save_calibration, save_rig
from torchface.io.ict_facekit import region
from torchface.io.images import load_image
from torchface.io.landmarks import load_landmark_points, save_pts
from torchface.io.landmarks_dlib import load_dlib_faces
from torchface.mesh import Mesh
from torchface.modeling import FitSettings, HeadModel, ImageFit, fit_images, transfer_with_report
from torchface.modeling.landmark_view import LANDMARKS
from torchface.rendering.compositing import save_picture
from torchface.rendering.raycast import RayCaster
from torchface.rendering.shading import Lighting, render, sample_texture
from torchface.rig import BlendshapeRig
from torchface.synthetic import performer
from torchface.workflows.found_landmarks import DEFAULT_LANDMARKS, FoundLandmarks, find_in_photographs
from torchface.workflows.rig import check_out
from torchface.workflows.rig_names import Naming, renamed
from torchface.workflows.skin import dressed_as, hidden_parts

_OVER, _MARGIN, _SHARE = 480, 0.45, 0.7
_LIGHT = Lighting(occlusion_rays=0)
_FOUND, _FIT = (0.1, 1.0, 0.2), (1.0, 0.1, 0.1)


@dataclass(frozen=True, eq=False)
class FittedHead:
    """What was made, and how near it comes to the photographs.

    Args:
        rig: the person's.
        fit: see ``ImageFit``.
        pictures: the files written, one a photograph: it, the fit over it, landmarks found (green) and fitted (red).
        transfer_summary: on triangles without area; empty where there are none.
        found: the landmarks that no file gave; empty where files gave them.
    """

    rig: BlendshapeRig
    fit: ImageFit
    pictures: tuple[Path, ...]
    transfer_summary: str
    found: tuple[FoundLandmarks, ...] = ()

    def lines(self, photographs: Sequence[Path]) -> list[str]:
        """For people to read."""
        fit = self.fit
        lines = [line for one in self.found for line in one.lines()]
        for i, (path, camera, error) in enumerate(zip(photographs, fit.cameras, fit.errors.tolist(), strict=True)):
            eyes = (fit.landmarks[i, 36] - fit.landmarks[i, 45]).norm()
            lines.append(
                f"{path.name}: landmarks {error:.2f} pixels off ({error / float(eyes):.1%} of the eyes' distance), "
                f"focal length {float(camera.intrinsics[0, 0]):.0f}"
            )
        lines.append(f"identity: largest coefficient {float(fit.coefficients.abs().max()):.2f} standard deviations")
        strongest = fit.weights.argsort(descending=True)[:5].tolist()
        shown = [f"{self.rig.names[k]} {float(fit.weights[k]):.2f}" for k in strongest if float(fit.weights[k]) > 0.05]
        lines.append(f"expression: {', '.join(shown) or 'none'}")
        if fit.color is not None:
            lines.append(f"colour model: {float(fit.color.error.mean()):.3f} off, of 1 a channel")
        lines.append(f"rig: {len(self.rig.vertices)} vertices, {len(self.rig.names)} shapes transferred")
        return lines + ([f"  note: {self.transfer_summary}"] if self.transfer_summary else [])


def fit_photographs(
    photographs: Sequence[Path],
    landmarks: Sequence[Path],
    model: str | Path,
    out: Path,
    template: Path | None = None,
    focal: float | None = None,
    settings: FitSettings | None = None,
    face: int | None = None,
    texture_size: int = 1024,
    progress: Callable[[str], None] | None = None,
    landmark_model: str | Path = DEFAULT_LANDMARKS,
    names: Naming | None = None,
    part: str | None = None,
) -> FittedHead:
    """Fits a head to photographs of one person with one expression and writes it as a rig.

    Args:
        photographs: image files.
        landmarks: 68 in iBUG's order for each photograph, in files (.pts, .ljson) or in one of dlib's XML for all;
            where there are none they are found, and written as .pts beside ``out``.
        model: a head model by name or folder; see ``zoo.get_model``.
        out: the ``.glb`` or folder to write, see ``save_rig``; overlays are written beside it.
        template: a rig with the model's topology; the model's own if absent, else the embedded performer where its
            topology is the model's.
        focal: length in pixels where it is known.
        settings: how landmarks are trusted.
        face: which of several, from 0: in the order of an XML, or where landmarks are found the largest first.
        texture_size: texels a side; 0 makes no texture.
        progress: called with a line before each step.
        landmark_model: finds landmarks where no file gives them; by name or folder.
        names: of the written shapes; see ``rig_names.renamed``.
        part: an annotated region that template and model are cut to, such as ``"face"`` of an ICT head.

    Raises:
        NoFaceError: landmarks are to be found where no face is.
        FileFormatError: ``out`` has another ending or cannot be written to, or a file is broken.
        NameMismatchError: landmarks do not tell which photograph or face they are of.
        TorchfaceError: landmarks or model are of no use; see ``fit_images``.
    """
    say = progress or (lambda line: None)
    check_out(out)
    say("reading the model")
    heads, rig = matching(load_head_model(model), template, part)
    say(f"reading {len(photographs)} photographs")
    images = [load_image(path) for path in photographs]
    found: list[FoundLandmarks] = []
    if landmarks or not photographs:
        marks = torch.stack(landmarks_of(photographs, landmarks, face))
    else:
        say(f"finding the landmarks of {len(photographs)} photographs")
        found = find_in_photographs(photographs, images, landmark_model, face)
        marks = torch.stack([one.trusted for one in found])
    sizes = [(image.shape[2], image.shape[1]) for image in images]
    fit = fit_images(
        heads,
        rig,
        marks,
        sizes,
        images,
        camera=focal,
        settings=settings,
        texture_size=texture_size,
        progress=say,
    )
    say(f"transferring {len(rig.names)} shapes")
    # Photographs show little of eyeballs and teeth: parts of their own keep the template's skin.
    unseen = hidden_parts(rig.neutral, torch.zeros(len(rig.vertices), dtype=torch.bool))
    worn = dressed_as(fit.mesh, rig.neutral, unseen)
    transferred = transfer_with_report(rig, worn)
    say("writing the rig and the overlays")
    save_rig(renamed(transferred.rig, names), out)
    pictures = tuple(out.with_name(f"{out.stem}_{i + 1}_{path.stem}.png") for i, path in enumerate(photographs))
    for i, (path, image) in enumerate(zip(pictures, images, strict=True)):  # a photograph a turn
        save_picture(overlay(fit, i, image, marks[i]), path)
    for picture, camera, (width, height), error in zip(pictures, fit.cameras, sizes, fit.errors.tolist(), strict=True):
        calibration = CameraCalibration(camera.intrinsics.double(), torch.zeros(5).double(), width, height, error)
        save_calibration(calibration, picture.with_suffix(".toml"))
    for picture, one in zip(pictures, found, strict=False):  # to be corrected and given as --landmarks
        save_pts(one.face.landmarks, picture.with_suffix(".pts"))
    return FittedHead(transferred.rig, fit, pictures, transferred.report.summary(), tuple(found))


def load_head_model(name_or_path: str | Path) -> HeadModel:
    """A head model by name or folder, see ``zoo.get_model``.

    Raises:
        NameMismatchError: there is none of this name, or it is of another kind.
    """
    found = zoo.get_model(name_or_path)
    if not isinstance(found, HeadModel):
        raise NameMismatchError(f"model: found {name_or_path}, a {type(found).__name__}, expected a HeadModel")
    return found


def matching(
    model: HeadModel, template: Path | None = None, part: str | None = None
) -> tuple[HeadModel, BlendshapeRig]:
    """A model, and the rig whose shapes its heads are to have, of one topology.

    Args:
        model: of heads.
        template: a rig; the one that travels with the model if absent, else the embedded performer.
        part: an annotated region, such as ``"face"``, that both are cut to; a model of that part alone stays as it is.

    Raises:
        TopologyError: the rig has another topology than the model.
        NameMismatchError: no such part.
    """
    source, rig = "the model's own rig", model.rig
    if template is not None:
        source, rig = str(template), load_rig(template)
    elif rig is None:
        source, rig = "the embedded performer", performer()
    parts = {} if rig.neutral.annotations is None else rig.neutral.annotations.regions
    if part is not None:
        keep = region(rig.neutral, part)
        if same_topology(model, rig):
            model = model.part(keep)
        rig = rig.part(keep)
    if same_topology(model, rig):
        return model, rig
    count = len(model.shape.mean)
    fitting = [name for name, mask in parts.items() if part is None and int(mask.sum()) == count]
    hint = "; name a rig with --template whose topology is the model's" if template is None else ""
    raise TopologyError(
        f"{source}: found {len(rig.vertices)} vertices and {len(rig.neutral.faces)} triangles, expected the model's "
        f"{count} and {len(model.faces)}" + (f"; try --part {fitting[0]}" if fitting else hint)
    )


def same_topology(model: HeadModel, rig: BlendshapeRig) -> bool:
    """Whether a model's heads have the rig's triangles."""
    return len(rig.vertices) == len(model.shape.mean) and torch.equal(rig.neutral.faces, model.faces.cpu())


def landmarks_of(photographs: Sequence[Path], files: Sequence[Path], face: int | None = None) -> list[Tensor]:
    """The landmarks (68,2) of each photograph: a file each, or one of dlib's XML that names them.

    Raises:
        NameMismatchError: another number of files than of photographs, or an XML that does not tell which face.
        FileFormatError: a broken file, or points that are no pixels.
        ShapeError: not 68 landmarks.
    """
    if not photographs:
        raise NameMismatchError("fit: found no photograph, expected one at least")
    if len(files) == 1 and files[0].suffix.lower() == ".xml":
        return [_face_in(files[0], path, face) for path in photographs]
    if len(files) != len(photographs):
        raise NameMismatchError(
            f"landmarks: found {len(files)} files for {len(photographs)} photographs, expected one each, or one .xml"
        )
    return [
        _face_in(file, photograph, face) if file.suffix.lower() == ".xml" else _pixels(file)
        for file, photograph in zip(files, photographs, strict=True)
    ]


def _pixels(file: Path) -> Tensor:
    points = load_landmark_points(file).ibug()
    if points.shape[1] != 2:
        raise FileFormatError(f"{file}: found points in space, three numbers each; expected pixels of a photograph")
    return points.double()


def _face_in(file: Path, photograph: Path, face: int | None) -> Tensor:
    faces = [one for one in load_dlib_faces(file) if Path(one.image.replace("\\", "/")).name == photograph.name]
    if not faces:
        raise NameMismatchError(f"{file}: found no face in {photograph.name}, expected one")
    if face is None and len(faces) > 1:
        places = ", ".join(f"{k}: at ({int(one.box[0])}, {int(one.box[1])})" for k, one in enumerate(faces[:20]))
        raise NameMismatchError(f"{file}: found {len(faces)} faces in {photograph.name}, choose one of --face {places}")
    number = face or 0
    if not 0 <= number < len(faces):
        raise NameMismatchError(f"{file}: found {len(faces)} faces in {photograph.name}, expected more than {number}")
    points = faces[number].points
    if points.shape != (LANDMARKS, 2):
        raise ShapeError(f"{file}: found {len(points)} landmarks in {photograph.name}, expected {LANDMARKS}")
    return points


def overlay(fit: ImageFit, view: int, image: Tensor, found: Tensor) -> Tensor:
    """A photograph, the fit over it, and the landmarks: found green, fitted red; (3,H,W), cut to the head.

    Args:
        fit: of I photographs.
        view: which of them.
        image: it, (3,H,W).
        found: its landmarks, (68,2).
    """
    camera, place = _cut(fit.cameras[view], found)
    piece = _sampled(image, place)
    mesh = fit.posed
    drawn = render(_clay(mesh), camera, lighting=_LIGHT, samples=1)
    origins, directions = camera.rays()
    caster = RayCaster(mesh.vertices, mesh.faces)
    hit = (caster.cast(origins.reshape(-1, 3), directions.reshape(-1, 3)).triangle >= 0).view(_OVER, _OVER)
    over = torch.where(hit, (1 - _SHARE) * piece + _SHARE * drawn, piece)
    dotted = piece
    for points, color in ((found, _FOUND), (fit.landmarks[view], _FIT)):
        dotted = _dotted(dotted, (points - place[:2]) * place[2], color)
    return torch.cat([piece, over, dotted], dim=2)


def _clay(mesh: Mesh) -> Mesh:
    """The bare form: what the photographs gave would hide where the form is off."""
    return Mesh(mesh.vertices, mesh.faces)


def _cut(camera: Camera, found: Tensor) -> tuple[Camera, Tensor]:
    """The camera of a square piece round the landmarks, and where that lies: left, top, pixels of it a pixel (3,)."""
    seen = found[torch.isfinite(found).all(-1)]
    low, high = seen.amin(0), seen.amax(0)
    side = float((high - low).max()) * (1 + 2 * _MARGIN)
    corner, scale = (low + high) / 2 - side / 2, _OVER / side
    zoom = torch.eye(3, dtype=torch.float64)
    zoom[0, 0] = zoom[1, 1] = scale
    zoom[:2, 2] = -corner * scale
    piece = Camera(zoom @ camera.intrinsics, camera.rotation, camera.translation, _OVER, _OVER)
    return piece, torch.cat([corner, torch.tensor([scale], dtype=torch.float64)])


def _sampled(image: Tensor, place: Tensor) -> Tensor:
    steps = torch.arange(_OVER, dtype=torch.float64) / place[2]
    y, x = torch.meshgrid(steps + place[1], steps + place[0], indexing="ij")
    height, width = image.shape[1:]
    uv = torch.stack([(x + 0.5) / width, 1 - (y + 0.5) / height], dim=-1).reshape(-1, 2)
    return sample_texture(image, uv).T.reshape(3, _OVER, _OVER)


def _dotted(image: Tensor, points: Tensor, color: tuple[float, float, float]) -> Tensor:
    """The image with a dot of three pixels at each point (L,2)."""
    spots = points[torch.isfinite(points).all(-1)].round().long()
    spots = spots[((spots >= 1) & (spots < _OVER - 1)).all(-1)]
    step = torch.tensor([-1, 0, 1])
    y = (spots[:, 1, None, None] + step[:, None]).expand(-1, 3, 3).flatten()
    x = (spots[:, 0, None, None] + step[None, :]).expand(-1, 3, 3).flatten()
    image = image.clone()
    image[:, y, x] = torch.tensor(color)[:, None]
    return image

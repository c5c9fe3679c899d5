"""Training of an appearance model: shapes first, then the textures that they are warped from."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.color_space import grey_images
from torchface.errors import ShapeError, ValueRangeError
from torchface.landmarks.images.appearance.appearance_level import AppearanceLevel, sample_pixels
from torchface.landmarks.images.appearance.appearance_model import AppearanceModel, AppearanceSettings
from torchface.landmarks.images.appearance.face_warp import FaceGrid, face_grid, face_triangles, with_forehead
from torchface.landmarks.images.appearance.shape_modes import learn_shape_modes, similarity_modes
from torchface.landmarks.images.ibug_68 import COUNT, MIRROR_68
from torchface.progress import Progress

_MIN_IMAGES = 3
_NOSE_BRIDGE = 29
_RANK = 1e-7


def learn_appearance(
    images: Sequence[Tensor], landmarks: Tensor, settings: AppearanceSettings, progress: Progress
) -> AppearanceModel:
    """See :meth:`AppearanceModel.fit`."""
    grey = [_checked(image, number) for number, image in enumerate(images)]
    _check_landmarks(grey, landmarks)
    landmarks = landmarks.detach().float()
    if settings.mirror:
        landmarks = torch.cat([landmarks, mirrored(landmarks, [image.shape[-1] for image in grey])])
        grey = [*grey, *(image.flip(-1) for image in grey)]
    shapes = learn_shape_modes(landmarks, settings.reach, settings.flexibility, settings.variance_kept)
    triangles = face_triangles(shapes.mean)
    points = with_forehead(shapes.mean[None], settings.jaw_margin)[0]
    grids = [face_grid(points * (one / settings.spacing), triangles) for one in settings.resolutions]
    modes = (2 if settings.parts else 1) * (len(grey) - 1)
    model = AppearanceModel(
        len(shapes.modes), [len(grid.pixels) for grid in grids], [modes] * len(grids), len(triangles), settings
    )
    model.mean_shape.copy_(shapes.mean)
    model.motions.copy_(torch.cat([similarity_modes(shapes.mean), shapes.modes]))
    model.deviations.copy_(shapes.deviations)
    model.triangles.copy_(triangles)
    for level, resolution, grid in zip(model.levels, settings.resolutions, grids, strict=True):
        _lay_out(model, level, resolution, grid)
    textures: list[list[Tensor]] = [[] for _ in grids]
    for number, (image, truth) in enumerate(zip(grey, landmarks, strict=True)):  # sizes differ
        for level, grid, level_textures in zip(model.levels, grids, textures, strict=True):
            level_textures.append(_textures(model, level, grid, image[None], truth[None]))
        progress("warping the images", number + 1, len(grey))
    for level, level_textures in zip(model.levels, textures, strict=True):
        _learn_textures(model, level, torch.stack(level_textures))
    return model.eval()


def mirrored(landmarks: Tensor, widths: Sequence[int]) -> Tensor:
    """Landmarks (M,68,2) of the mirror images of images with these widths, pixels."""
    flipped = landmarks[:, list(MIRROR_68)].clone()
    flipped[..., 0] = flipped.new_tensor(widths)[:, None] - 1 - flipped[..., 0]
    return flipped


def _lay_out(model: AppearanceModel, level: AppearanceLevel, resolution: float, grid: FaceGrid) -> None:
    """Where a level's places are, and how they move with the shape."""
    level.corner.copy_(model.triangles[grid.triangle])
    level.weight.copy_(grid.barycentric)
    level.scale.fill_(resolution)
    moved = with_forehead(model.motions, model.settings.jaw_margin)
    level.motion.copy_(torch.einsum("qnkd,nk->ndq", moved[:, level.corner], level.weight) * resolution)


def _textures(model: AppearanceModel, level: AppearanceLevel, grid: FaceGrid, image: Tensor, truth: Tensor) -> Tensor:
    """A face's texture, and its change a pixel of the mean shape along x and y, (3,C,N).

    Steps of a pixel are taken in the mean shape and carried into the image by the triangle's own affine map, so that
    nothing is read across the border of the face.
    """
    crop = model.crop(image, truth, float(level.scale))
    points = with_forehead(crop.pose.undo(truth), model.settings.jaw_margin)
    corners = points[:, level.corner]
    middle = sample_pixels(crop.features, (corners * level.weight[..., None]).sum(2))
    parts = [middle]
    for axis in (0, 1):
        # The grid counts in places; a pixel is 1/spacing of one.
        step = grid.gradient[..., axis, None] / model.settings.spacing
        ahead, behind = (
            sample_pixels(crop.features, (corners * (level.weight[..., None] + way * step)).sum(2))
            for way in (1.0, -1.0)
        )
        parts.append((ahead - behind) / 2)
    return torch.cat(parts)


def _learn_textures(model: AppearanceModel, level: AppearanceLevel, textures: Tensor) -> None:
    """Mean, modes, slopes and noise of a level from (M,3,C,N)."""
    above = model.mean_shape[:, 1] < model.mean_shape[_NOSE_BRIDGE, 1]
    upper = torch.cat([above, above.new_ones(10)])[level.corner].float().mean(1) > 0.5
    masks = [upper, ~upper] if model.settings.parts else [torch.ones_like(upper)]
    mean = textures.mean(0, dtype=torch.float64)  # exact where all are the same
    level.mean.copy_(mean[0])
    level.slope[0].copy_(mean[1:].permute(1, 2, 0))
    centred = textures - mean
    left = torch.zeros((), dtype=torch.float64)
    for part, mask in enumerate(masks):
        rows = slice(part * (len(textures) - 1), (part + 1) * (len(textures) - 1))
        flat = (centred[:, 0] * mask).flatten(1)
        gram = flat @ flat.T
        if not bool(gram.any()):
            raise ValueRangeError("images: found faces that all look the same, expected some that differ")
        values, vectors = torch.linalg.eigh(gram)
        values, vectors = values.flip(0)[:-1], vectors.flip(1)[:, :-1]
        scaled = torch.where(values > _RANK * values[0], values.clamp(min=1e-30).rsqrt(), 0.0)
        mixing = (vectors * scaled).T
        modes = torch.einsum("km,mdcn->kdcn", mixing, centred * mask)
        level.modes[rows].copy_(modes[:, 0])
        level.slope[1:][rows].copy_(modes[:, 1:].permute(0, 2, 3, 1))
        left += left_out_residual(gram)
    typical = left / (len(textures) * textures[0, 0].numel())
    level.typical.copy_(typical.clamp(min=1e-8))
    level.noise.copy_(level.typical * model.settings.shape_weight / model.settings.spacing**2)


def left_out_residual(gram: Tensor) -> Tensor:
    r"""What the span of all others leaves of each centred sample, squared and summed; of their Gram matrix (M,M).

    For the affine span of the others the residual's square is :math:`1 / (K^{-1})_{ii}` of the Gram matrix bordered
    with ones.
    """
    count = len(gram)
    bordered = gram.new_ones(count + 1, count + 1)
    bordered[-1, -1] = 0
    bordered[:count, :count] = gram + 1e-9 * gram.diagonal().mean() * torch.eye(count, dtype=gram.dtype)
    return (1 / torch.linalg.inv(bordered).diagonal()[:count]).sum()


def _checked(image: Tensor, number: int) -> Tensor:
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[0] not in (1, 3)) or min(image.shape[-2:]) < 16:
        raise ShapeError(f"image {number}: found {tuple(image.shape)}, expected (H,W) or (3,H,W), 16 pixels or more")
    values = image.float() / 255 if image.dtype == torch.uint8 else image.detach().float()
    if not bool(torch.isfinite(values).all()):
        raise ValueRangeError(f"image {number}: found NaN or infinity, expected values in [0,1]")
    return grey_images(values.reshape(1, -1, *image.shape[-2:]))[0]


def _check_landmarks(images: Sequence[Tensor], landmarks: Tensor) -> None:
    if len(images) < _MIN_IMAGES:
        raise ShapeError(f"images: found {len(images)}, expected at least {_MIN_IMAGES} to learn how a face moves")
    if landmarks.shape != (len(images), COUNT, 2):
        raise ShapeError(f"landmarks: found {tuple(landmarks.shape)}, expected {(len(images), COUNT, 2)}")
    for number, (image, points) in enumerate(zip(images, landmarks, strict=True)):
        if not bool(torch.isfinite(points).all()):
            raise ValueRangeError(f"landmarks {number}: found NaN or infinity, expected all 68")
        size = points.new_tensor([image.shape[-1], image.shape[-2]])
        if bool(((points < -0.5 * size) | (points > 1.5 * size)).any()):
            raise ValueRangeError(
                f"landmarks {number}: found some far outside the image of {int(size[0])} x {int(size[1])} pixels"
            )
        if float(points.std(0).min()) < 1:
            raise ValueRangeError(f"landmarks {number}: found all on one line, expected a face")

"""Head models of others as ``HeadModel``."""

import torch

from torchface.errors import FileFormatError
from torchface.io.head_models.head_model_file import HeadModelFile
from torchface.modeling.morphable.head_model import HeadModel
from torchface.modeling.morphable.morphable_model import MorphableModel
from torchface.rig import BlendshapeRig

_LEAST = 1e-5  # of the largest deviation


def head_model_of(file: HeadModelFile, rig: BlendshapeRig | None = None, components: int | None = None) -> HeadModel:
    r"""The Gaussian model of shape that a published model's identity parameters are.

    Its ways to differ M need not be orthogonal; with parameters from N(0,I) their covariance is :math:`M^\top M`, whose
    principal components these are. The same heads are equally likely, by other coefficients.

    Args:
        file: the model.
        rig: shapes of its topology that travel with it; its neutral's annotations replace the file's.
        components: how many are kept, of the largest deviations; all if absent.

    Raises:
        FileFormatError: the model has no identity parameters.

    Example:
        >>> from torchface import Mesh
        >>> mean = Mesh(torch.eye(4, 3), torch.tensor([[0, 1, 2]]))
        >>> ways = torch.stack([torch.ones(4, 3), torch.eye(4, 3)])
        >>> model = head_model_of(HeadModelFile("two", mean, ways, ways[:0], ()))
        >>> model.shape.count, round(float(model.shape.standard_deviations.square().sum()), 3)
        (2, 15.0)
    """
    modes = file.identity.flatten(1)
    gram = (modes.double() @ modes.double().T) if len(modes) else torch.zeros(0, 0)
    if not len(modes) or not float(gram.diagonal().max()) > 0:
        raise FileFormatError(f"{file.name}: found no identity parameters that move a vertex, expected some")
    values, vectors = torch.linalg.eigh(gram)
    deviations = values.clamp(min=0).sqrt().flip(0)
    kept = int((deviations > _LEAST * deviations[0]).sum())
    kept = kept if components is None else min(kept, components)
    toward = (vectors.flip(1)[:, :kept] / deviations[:kept]).to(modes)
    mean = file.neutral.vertices
    shape = MorphableModel(mean, (toward.T @ modes).unflatten(1, mean.shape), deviations[:kept].to(modes))
    return HeadModel.on(file.neutral if rig is None else rig.neutral, shape, rig=rig)

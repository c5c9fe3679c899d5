"""Head models of others by path, whichever project's they are."""

from pathlib import Path

from torchface.errors import FileFormatError
from torchface.io.head_models import basel, eos, flame, gnm, mhr
from torchface.io.head_models.array_files import ArrayFile, is_pickle
from torchface.io.head_models.head_model_file import HeadModelFile

HEAD_MODEL_ENDINGS = (".npz", ".safetensors", ".h5", ".hdf5", eos.ENDING)
_FORMS = "GNM Head's gnm_head.npz, FLAME's arrays as .npz or .safetensors, MHR's lodN.npz, Basel's .h5, or eos's .bin"


def is_head_model_file(path: str | Path) -> bool:
    """Whether a path is a file that :func:`load_head_model_file` reads or explains, by its first bytes and names.

    A pickle is one: the error says how to convert it.
    """
    path = Path(path)
    if not path.is_file():
        return False
    if is_pickle(path) or basel.is_hdf5(path) or eos.is_eos(path):
        return True
    if path.suffix.lower() not in HEAD_MODEL_ENDINGS:
        return False
    try:
        arrays = ArrayFile(path)
    except FileFormatError:
        return True
    return any(name in arrays for one in (gnm, flame, mhr) for name in one.MARKS)


def load_head_model_file(path: str | Path) -> HeadModelFile:
    """A head model as its authors' file has it, in millimetres: GNM Head, FLAME, MHR, Basel or eos's.

    Which one it is the names of its arrays say. No pickle is opened. Landmarks are read of a file beside the model
    where its project keeps them in one.

    Raises:
        FileFormatError: no such file, a pickle, damaged, other arrays or shapes, NaN, or too large; the message says
            what was found and, for a pickle, how to convert it.
        MissingExtraError: an HDF5 file, and h5py is not installed.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     arrays = {"v_template": np.eye(4, 3), "shapedirs": np.zeros((4, 3, 400)), "f": [[0, 1, 2], [0, 2, 3]]}
        ...     np.savez(f"{folder}/tiny.npz", **arrays)
        ...     model = load_head_model_file(f"{folder}/tiny.npz")
        >>> model.name, len(model.identity), len(model.expressions)
        ('FLAME', 300, 100)
    """
    path = Path(path)
    if path.is_file() and basel.is_hdf5(path):
        return basel.read_basel(path)
    if path.is_file() and eos.is_eos(path):
        return eos.read_eos(path)
    arrays = ArrayFile(path)
    if all(name in arrays for name in gnm.MARKS):
        return gnm.read_gnm(path, arrays)
    if all(name in arrays for name in flame.MARKS):
        return flame.read_flame(path, arrays)
    if all(name in arrays for name in mhr.MARKS):
        return mhr.read_mhr(arrays)
    raise FileFormatError(f"{path}: found the arrays {', '.join(arrays.names[:12]) or 'none'}, expected {_FORMS}")

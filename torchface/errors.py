"""What can go wrong at the user's end, one class a kind; every message says what was found and what was expected."""


class TorchfaceError(Exception):
    """The root of every error that bad input causes."""


class ShapeError(TorchfaceError):
    """A tensor has another shape than the docstring asks for."""


class ValueRangeError(TorchfaceError):
    """A number is NaN, infinite, negative or otherwise outside what makes sense."""


class FileFormatError(TorchfaceError):
    """A file cannot be read as what its name says it is."""


class NameMismatchError(TorchfaceError):
    """Shape names or marker labels do not match."""


class TopologyError(TorchfaceError):
    """Meshes, rigs or attachments of different topology were put together, or a mesh's indices are broken."""


class AlignmentError(TorchfaceError):
    """Two things could not be laid on one another without help."""


class MissingExtraError(TorchfaceError):
    """An optional dependency is not installed."""


class TraceError(TorchfaceError):
    """A module whose path depends on its data was traced by ``torch.jit.trace``."""

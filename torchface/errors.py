"""Errors that bad input causes, one class a kind; every message says what was found and what was expected."""

__all__ = [
    "AlignmentError",
    "ArgumentTypeError",
    "FileFormatError",
    "MissingExtraError",
    "NameMismatchError",
    "NoShapesError",
    "ShapeError",
    "TopologyError",
    "TorchfaceError",
    "TraceError",
    "ValueRangeError",
]


class TorchfaceError(Exception):
    """The root of every error that bad input causes.

    Example:
        >>> from torchface import TorchfaceError, load_mesh
        >>> try:
        ...     load_mesh("head.dae")
        ... except TorchfaceError as error:
        ...     print(error)
        head.dae: found the ending '.dae', expected .obj, .ply, .stl, .off, .glb, ...
    """


class ArgumentTypeError(TorchfaceError, TypeError):
    """An argument is of another type than the docstring asks for, and cannot safely be made one.

    Example:
        >>> from torchface.modeling import transfer_deformation
        >>> transfer_deformation("template.glb", None)
        Traceback (most recent call last):
            ...
        torchface.errors.ArgumentTypeError: source: found the text 'template.glb', expected a BlendshapeRig...
    """


class ShapeError(TorchfaceError):
    """A tensor has another shape than the docstring asks for.

    Example:
        >>> from torchface import Mesh
        >>> Mesh(torch.zeros(4, 2), torch.tensor([[0, 1, 2]]))
        Traceback (most recent call last):
            ...
        torchface.errors.ShapeError: vertices: found (4, 2), expected (*,3)
    """


class ValueRangeError(TorchfaceError):
    """A number is NaN, infinite, negative or otherwise outside what makes sense.

    Example:
        >>> from torchface import Mesh
        >>> Mesh(torch.full((3, 3), torch.nan), torch.tensor([[0, 1, 2]]))
        Traceback (most recent call last):
            ...
        torchface.errors.ValueRangeError: mesh: 3 of 3 vertices are NaN or infinite; expected none
    """


class FileFormatError(TorchfaceError):
    """A file cannot be read as what its name says it is.

    Example:
        >>> from pathlib import Path
        >>> from torchface import load_mesh
        >>> _ = Path("head.obj").write_text("no vertices here")
        >>> load_mesh("head.obj")
        Traceback (most recent call last):
            ...
        torchface.errors.FileFormatError: head.obj: found no vertex (line 'v x y z'), expected an OBJ mesh
    """


class NoShapesError(FileFormatError):
    """A file is whole and holds a mesh, but no blend shape: no rig.

    Example:
        >>> from torchface import Mesh, load_rig
        >>> from torchface.io import save_mesh
        >>> save_mesh(Mesh(torch.eye(3), torch.tensor([[0, 1, 2]])), "head.glb")
        >>> load_rig("head.glb")
        Traceback (most recent call last):
            ...
        torchface.errors.NoShapesError: head.glb: found no morph target in its one mesh, expected at least one for a ...
    """


class NameMismatchError(TorchfaceError):
    """Shape names or marker labels do not match.

    Example:
        >>> from torchface import BlendshapeRig
        >>> rig = BlendshapeRig.from_tensors(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.ones(1, 3, 3), ["jawOpen"])
        >>> rig.select(["jawopen"])
        Traceback (most recent call last):
            ...
        torchface.errors.NameMismatchError: rig: no shape 'jawopen'; its 1 shapes are jawOpen, ...
    """


class TopologyError(TorchfaceError):
    """Meshes, rigs or attachments of different topology were put together, or a mesh's indices are broken.

    Example:
        >>> from torchface import Mesh
        >>> Mesh(torch.eye(3), torch.tensor([[0, 1, 3]]))
        Traceback (most recent call last):
            ...
        torchface.errors.TopologyError: faces: found indices 0 to 3, expected 0 to 2
    """


class AlignmentError(TorchfaceError):
    """Two things could not be aligned without help.

    Example:
        >>> from torchface.registration.scan_preparation import check_same_hand
        >>> from torchface.synthetic import neutral_head
        >>> head = neutral_head(texture=False)
        >>> points = head.vertices[head.landmarks]
        >>> check_same_hand(points, points * torch.tensor([-1.0, 1.0, 1.0]))
        Traceback (most recent call last):
            ...
        torchface.errors.AlignmentError: landmarks: found a mirror image of the template's...
    """


class MissingExtraError(TorchfaceError):
    """An optional dependency is not installed.

    Example:
        >>> from torchface.files.extra_packages import import_extra
        >>> import_extra("no_such_module", "viser", "viewer", "the viewer")
        Traceback (most recent call last):
            ...
        torchface.errors.MissingExtraError: the viewer needs viser, which is not installed ...pip install ...
    """


class TraceError(TorchfaceError):
    """A module whose path depends on its data was traced by ``torch.jit.trace``.

    Example:
        >>> from torchface.optim import box_qp
        >>> torch.jit.trace(lambda f: box_qp(torch.eye(9), f), torch.ones(9, 9))
        Traceback (most recent call last):
            ...
        torchface.errors.TraceError: box_qp: iterates until every problem is solved...
    """

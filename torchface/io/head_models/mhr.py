"""Meta's MHR, a level of detail as ``lodN.npz``: a whole body with 45 ways to differ and 72 facial expressions.

Source: facebookresearch/MHR (Apache-2.0), whose converter names the arrays and the expressions.
"""

from torchface.io.head_models.array_files import ArrayFile
from torchface.io.head_models.head_model_file import HeadModelFile
from torchface.mesh import Mesh

NAME = "MHR"
MARKS = ("base_shape", "shape_vectors")
_UNIT = 10.0
_PAIRED = (
    *("browLowerer", "cheekPuff", "cheekRaiser", "cheekSuck", "chinRaiser:BT", "dimpler", "eyesClosed"),
    *("eyesLookDown", "eyesLookLeft", "eyesLookRight", "eyesLookUp", "innerBrowRaiser", "jawDrop:", "jawSideways:*"),
    *("jawThrust:", "lidTightener", "lipCornerDepressor", "lipCornerPuller", "lipFunneler:4", "lipPressor"),
    *("lipPucker", "lipStretcher", "lipSuck:4", "lipTightener", "lipsToward:4", "lowerLipDepressor", "mouth:*"),
    *("nasolabialFurrow", "noseWrinkler", "nostrilCompressor", "nostrilDilator", "outerBrowRaiser"),
    *("upperLidRaiser", "upperLipRaiser"),
)


def _names() -> tuple[str, ...]:
    """The 72 in the model's order: sides, lips' quarters, or none behind each."""
    ends = {"": [""], "BT": ["_B", "_T"], "4": ["_LB", "_LT", "_RB", "_RT"], "*": ["Left", "Right"]}
    names = []
    for one in _PAIRED:
        stem, _, kind = one.partition(":")
        names += [stem + end for end in (ends[kind] if ":" in one else ["_L", "_R"])]
    return tuple(names)


EXPRESSIONS = _names()


def read_mhr(arrays: ArrayFile) -> HeadModelFile:
    """Reads a level of detail; its skeleton lies in another file and is left out."""
    count = arrays.check_vertices("base_shape")
    vectors = arrays.numbers("shape_vectors", None, count, 3) * _UNIT
    split = len(vectors) - len(EXPRESSIONS)
    if split < 0:
        raise arrays.error("shape_vectors", f"(45+{len(EXPRESSIONS)},V,3)")
    uvs = uv_faces = None
    faces = arrays.indices("faces", None, 3, below=count)
    if "texcoords" in arrays and "texcoord_faces" in arrays:
        uvs = arrays.numbers("texcoords", None, 2)
        uv_faces = arrays.indices("texcoord_faces", len(faces), 3, below=len(uvs))
    mesh = Mesh(arrays.numbers("base_shape", count, 3) * _UNIT, faces, uvs, uv_faces)
    return HeadModelFile(NAME, mesh, vectors[:split], vectors[split:], EXPRESSIONS, licence="Apache-2.0")

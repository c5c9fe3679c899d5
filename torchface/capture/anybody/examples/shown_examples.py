"""Examples from pictures of a person: heads brought to one place, and what looks wrong said."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchface.capture.anybody.examples.example_expressions import NEUTRAL, paper_expressions
from torchface.capture.anybody.examples.example_shapes import ExampleShapes
from torchface.capture.anybody.examples.expression_regions import HEAD_LANDMARKS
from torchface.errors import NameMismatchError, ShapeError

_LEFT, _RIGHT = (
    (*range(22, 27), *range(42, 48), 52, 53, 54, 55, 63),
    (*range(17, 22), *range(36, 42), 48, 49, 50, 59, 61),
)
_FAINT = 0.01  # of the eyes' distance, root mean square over the tenth of the landmarks that moves most


def shown_examples(names: Sequence[str], landmarks: Tensor) -> ExampleShapes:
    """Examples from landmarks of one person in as many pictures.

    Between two pictures a head moves. So the nose and the corners of the eyes, which expressions move least, are
    brought onto the neutral's by a similarity; where the paper's expressions turn the head, by a shift alone.

    Args:
        names: what the pictures show, ``neutral`` among them; the order of what comes out.
        landmarks: iBUG's 68, (K,68,2), pixels, of pictures of one size.

    Raises:
        NameMismatchError: no neutral, or a name twice.
        ShapeError: not as many faces as names.

    Example:
        >>> from torchface.capture.anybody import paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> pictures = torch.stack([examples.neutral, examples.landmarks[0] + 5.0])  # the head moved
        >>> shown = shown_examples(["neutral", examples.names[0]], pictures)
        >>> shown.names, bool((shown.landmarks[0] - examples.landmarks[0]).abs().mean() < 1)
        (('brow_lower_left',), True)
    """
    if landmarks.shape != (len(names), 68, 2):
        raise ShapeError(f"examples: found landmarks {tuple(landmarks.shape)}, expected ({len(names)},68,2)")
    if NEUTRAL not in names:
        raise NameMismatchError(f"examples: found {', '.join(list(names)[:5])}, ..., expected {NEUTRAL!r} among them")
    turning = {expression.name for expression in paper_expressions() if expression.yaw or expression.roll}
    first = list(names).index(NEUTRAL)
    neutral = landmarks[first].double()
    others = [row for row in range(len(names)) if row != first]
    moved = [_onto(landmarks[row].double(), neutral, names[row] not in turning) for row in others]
    shapes = torch.stack(moved) if moved else landmarks.new_zeros(0, 68, 2)
    return ExampleShapes(tuple(names[row] for row in others), neutral.float(), shapes.float())


def example_remarks(examples: ExampleShapes) -> list[str]:
    """What somebody should know of examples of a person, a sentence each: mirrored pictures, faces that hardly move.

    Example:
        >>> from torchface.capture.anybody import paper_examples
        >>> from torchface.synthetic import performer
        >>> examples = paper_examples(performer(texture=False))
        >>> example_remarks(examples)
        []
        >>> still = ExampleShapes(("smile",), examples.neutral, examples.neutral[None])
        >>> example_remarks(still)[0][:38]
        'warning: smile hardly differ from the '
    """
    moves = (examples.landmarks - examples.neutral).norm(dim=-1) / examples.eyes_distance
    strongest = moves.sort(dim=1, descending=True).values[:, :7].square().mean(1).sqrt()
    faint = [name for name, size in zip(examples.names, strongest.tolist(), strict=True) if size < _FAINT]
    remarks = []
    if faint:
        remarks.append(
            f"warning: {', '.join(faint)} hardly differ from the neutral (less than {_FAINT:.0%} of the eyes' distance)"
        )
    sided = [
        (name, float(moves[row, list(_LEFT)].square().sum()), float(moves[row, list(_RIGHT)].square().sum()))
        for row, name in enumerate(examples.names)
        if name.lower().endswith(("left", "right")) and not name.startswith(("rotate", "tilt"))
    ]
    wrong = [name for name, left, right in sided if (left < right) == name.lower().endswith("left")]
    if len(sided) > 1 and 2 * len(wrong) > len(sided):
        remarks.append(
            f"warning: {len(wrong)} of {len(sided)} one-sided expressions move the other side ({', '.join(wrong)}): "
            "mirrored pictures? left is the person's left"
        )
    return remarks


def _onto(points: Tensor, neutral: Tensor, similarity: bool) -> Tensor:
    """Points (68,2) moved so that the head lies where the neutral's lies."""
    rows = list(HEAD_LANDMARKS)
    middle, wanted = points[rows].mean(0), neutral[rows].mean(0)
    if not similarity:
        return points - middle + wanted
    source, target = points[rows] - middle, neutral[rows] - wanted
    along = (source * target).sum()
    across = (source[:, 0] * target[:, 1] - source[:, 1] * target[:, 0]).sum()
    size = source.square().sum().clamp(min=1e-12)
    turn = torch.stack([torch.stack([along, across]), torch.stack([-across, along])]) / size
    return (points - middle) @ turn + wanted

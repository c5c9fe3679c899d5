"""The paper's 16 expressions in its order, what each means in ARKit's shapes, and how they move a character."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import NameMismatchError
from torchface.files.documents import read_toml
from torchface.shape_names import ARKIT, mapping, spelled_as

NEUTRAL = "neutral"
"""The name of the face at rest, the first of the 16."""

_FORMAT = "torchface.example_expressions/1"
_TABLE = Path(__file__).with_name("tables") / "paper_expressions.toml"


@dataclass(frozen=True)
class ExampleExpression:
    """One expression that somebody shows.

    Args:
        name: of the expression.
        prompt: what the person is asked to do.
        shapes: weights by ARKit's names.
        yaw, roll: of the head, degrees: toward the person's left, the crown toward the person's left shoulder.

    Example:
        >>> pucker = ExampleExpression("kiss", "Purse your lips.", {"mouthPucker": 1.0}, yaw=0.0, roll=0.0)
        >>> pucker.shapes
        {'mouthPucker': 1.0}
    """

    name: str
    prompt: str
    shapes: dict[str, float]
    yaw: float
    roll: float


@cache
def paper_expressions() -> tuple[ExampleExpression, ...]:
    """The 16 of the paper: neutral, 11 expressions, and the head turned and tilted to either side.

    Source: realtime_facial_animation, appendix, ``initial_example_face_matrix``.

    Example:
        >>> expressions = paper_expressions()
        >>> len(expressions), expressions[0].name, expressions[0].shapes
        (16, 'neutral', {})
    """
    rows = read_toml(_TABLE, _FORMAT)["expressions"].rows()
    return tuple(
        ExampleExpression(
            row["name"].text(),
            row["prompt"].text(),
            {name: weight.number() for name, weight in row["shapes"].table().items()} if row["shapes"] else {},
            row["yaw"].number() if row["yaw"] else 0.0,
            row["roll"].number() if row["roll"] else 0.0,
        )
        for row in rows
    )


def character_matrix(names: Sequence[str], shapes: Sequence[str]) -> Tensor:
    """The matrix (M,N) that turns weights of examples into weights of a character's shapes, by name.

    Examples become the shape of their own name, else the paper's expressions the shapes of ARKit that they mean;
    those that turn the head move no shape. Order and count need not agree. Clamp what comes
    out to [0,1]: two expressions may share a shape.

    Args:
        names: of the N examples.
        shapes: of the character, M.

    Raises:
        NameMismatchError: no example moves a shape of the character.

    Example:
        >>> character_matrix(["jawOpen", "jawLeft"], ["jawLeft", "jawOpen"]).tolist()
        [[0.0, 1.0], [1.0, 0.0]]
    """
    known = {expression.name: expression for expression in paper_expressions()}
    matrix = mapping(names, shapes)
    onto = mapping(ARKIT, shapes)
    for column, name in enumerate(names):
        if name in known and spelled_as(name, shapes) is None:
            matrix[:, column] = onto @ torch.tensor([known[name].shapes.get(shape, 0.0) for shape in ARKIT])
    if not bool(matrix.any()):
        raise NameMismatchError(
            f"character: found the shapes {', '.join(list(shapes)[:5])}, ..., of which no example "
            f"({', '.join(list(names)[:5])}, ...) moves any, expected ARKit's names; see torchface retarget"
        )
    return matrix

"""A one-sided expression tells mirrored scans; a symmetric one, a weak one and another person's do not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.rig import BlendshapeRig
from torchface.shape_names import mirror
from torchface.synthetic import performer
from torchface.workflows.rig.expression_side import check_side


@pytest.fixture(scope="module")
def actor() -> BlendshapeRig:
    return performer(texture=False)


def weights(actor: BlendshapeRig, **given: float) -> Tensor:
    row = torch.zeros(len(actor.names))
    for name, value in given.items():
        row[actor.index([name])[0]] = value
    return row


def shown(actor: BlendshapeRig, row: Tensor) -> Tensor:
    noise = 0.3 * torch.randn(actor.vertices.shape, generator=torch.Generator().manual_seed(0))
    return actor(row[None])[0] + noise


ONE_SIDED: tuple[dict[str, float], ...] = (
    {"mouthSmileLeft": 0.8},
    {"jawRight": 0.8},
    {"jawOpen": 0.5, "browDownLeft": 1.0, "mouthSmileRight": 0.6},
)


@pytest.mark.parametrize("given", ONE_SIDED)
def test_the_other_side_is_told_with_both_distances(actor: BlendshapeRig, given: dict[str, float]) -> None:
    asked = weights(actor, **given)
    seen = torch.ones(len(actor.vertices), dtype=torch.bool)
    # Another person shows two thirds of it.
    check_side(actor, asked, shown(actor, asked * 2 / 3), seen)
    other = asked[mirror(actor.names)]
    with pytest.raises(
        AlignmentError,
        match=r"other side: \S+ mm \(root mean square, across the skin\) .*, \S+ mm from the mirror image",
    ):
        check_side(actor, asked, shown(actor, other * 2 / 3), seen)
    check_side(actor, asked, shown(actor, other), ~seen)  # what the scan does not show tells nothing


@pytest.mark.parametrize("given", [{"jawOpen": 1.0}, {"mouthSmileLeft": 0.5, "mouthSmileRight": 0.5}, {}])
def test_a_symmetric_expression_tells_nothing(actor: BlendshapeRig, given: dict[str, float]) -> None:
    seen = torch.ones(len(actor.vertices), dtype=torch.bool)
    check_side(actor, weights(actor, **given), shown(actor, weights(actor, mouthSmileRight=1.0)), seen)

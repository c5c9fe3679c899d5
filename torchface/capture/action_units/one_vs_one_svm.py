"""A linear support vector machine for many classes: a plane for each pair, and a vote."""

from itertools import combinations

import torch
from torch import Tensor, nn

from torchface.errors import ShapeError, ValueRangeError


class OneVsOne(nn.Module):
    r"""Votes of one plane for every two classes.

    .. math:: d_{ij} = w_{ij} \cdot x + b_{ij}, \qquad
        s_c = \sum_{c\text{ wins}} 1 + \frac{m_c}{3 (\lvert m_c \rvert + 1)}, \quad
        m_c = \sum_j d_{cj} - \sum_i d_{ic}

    where d > 0 is a vote for i. The second term is less than a vote and breaks ties.

    Source: thesis 4.1.11; scikit-learn's ``SVC`` with ``break_ties``.
    """

    weight: Tensor
    bias: Tensor
    first_class: Tensor
    second_class: Tensor

    def __init__(self, classes: int, features: int) -> None:
        super().__init__()
        pairs = torch.tensor(list(combinations(range(classes), 2)), device="cpu").view(-1, 2)
        self.register_buffer("weight", torch.zeros(len(pairs), features))
        self.register_buffer("bias", torch.zeros(len(pairs)))
        one_hot = torch.nn.functional.one_hot(pairs, classes).float()
        self.register_buffer("first_class", one_hot[:, 0].clone())
        self.register_buffer("second_class", one_hot[:, 1].clone())

    def forward(self, features: Tensor) -> Tensor:
        """Scores (B,C) of features (B,K); the highest wins."""
        distance = features @ self.weight.T + self.bias
        first = (distance > 0).to(distance.dtype)
        votes = first @ self.first_class + (1 - first) @ self.second_class
        margin = distance @ (self.first_class - self.second_class)
        return votes + margin / (3 * (margin.abs() + 1))

    def fit(self, features: Tensor, classes: Tensor, penalty: float = 1.0) -> "OneVsOne":
        """Learns the planes from features (T,K) of classes (T,), each of which occurs; ``penalty`` is C, of a margin
        violation."""
        count = self.first_class.shape[1]
        if features.shape != (len(classes), self.weight.shape[1]):
            raise ShapeError(
                f"features: found {tuple(features.shape)}, expected ({len(classes)},{self.weight.shape[1]})"
            )
        if not torch.equal(classes.unique(), torch.arange(count)):
            raise ValueRangeError(f"classes: found {classes.unique().tolist()}, expected every one of 0 to {count - 1}")
        from sklearn.svm import SVC  # takes a second, and only training needs it

        machine = SVC(kernel="linear", C=penalty, cache_size=500)
        machine.fit(features.double().numpy(), classes.numpy())
        # Between two classes alone scikit-learn's sign is opposite: positive for the second.
        sign = -1.0 if count == 2 else 1.0
        self.weight.copy_(sign * torch.tensor(machine.coef_))
        self.bias.copy_(sign * torch.tensor(machine.intercept_))
        return self

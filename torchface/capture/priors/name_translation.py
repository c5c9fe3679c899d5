"""The shapes of a rig in the names that a prior has learned."""

from collections.abc import Sequence

from torch import Tensor

from torchface.errors import NameMismatchError
from torchface.number_checks import checked_type
from torchface.shape_names import mapping

_MIN_LEARNED = 0.5


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names of shapes to learn, as a tuple, each once."""
    names = tuple(checked_type("names: a name", name, str) for name in names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise NameMismatchError(f"names: found more than once: {', '.join(twice[:5])}; expected each once")
    return names


def name_matrices(learned: Sequence[str], names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """The matrices (L,N) and (N,L) from a rig's N weights to L learned ones and back.

    See :func:`torchface.shape_names.mapping`; a shape of the rig that the prior has not learned has a row of zeros in
    the second.
    """
    there, back = mapping(names, learned), mapping(learned, names)
    known = back.any(1)
    if float(known.float().mean()) < _MIN_LEARNED:
        unknown = [name for name, found in zip(names, known.tolist(), strict=True) if not found]
        raise NameMismatchError(
            f"prior: has learned {int(known.sum())} of the rig's {len(names)} shapes "
            f"(none of {', '.join(unknown[:3])}, ...), expected at least half of them; it has "
            f"{', '.join(learned[:3])}, ... (train.priors --rig makes a prior for a rig's names)"
        )
    return there, back


def unlearned(learned: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """The shapes of a rig that a prior has not learned, under whatever name: it says nothing of them.

    Example:
        >>> unlearned(["jawOpen", "eyeBlinkLeft"], ["jawOpen", "eyeBlink_L", "tongueOut"])
        ('tongueOut',)
    """
    known = mapping(learned, names).any(1).tolist()
    return tuple(name for name, found in zip(names, known, strict=True) if not found)


def require_same_names(learned: Sequence[str], names: Sequence[str]) -> None:
    """Checks that a rig's shapes are those that a prior is for."""
    if tuple(names) == tuple(learned):
        return
    lacking = [name for name in learned if name not in set(names)]
    beyond = [name for name in names if name not in set(learned)]
    found = []
    if lacking:
        found.append(f"{len(lacking)} that the rig lacks ({', '.join(lacking[:3])})")
    if beyond:
        found.append(f"none of {len(beyond)} that it has ({', '.join(beyond[:3])})")
    if not found:
        row = next(i for i, pair in enumerate(zip(learned, names, strict=False)) if pair[0] != pair[1])
        found.append(f"{learned[row]} in place {row} where the rig has {names[row]}")
    raise NameMismatchError(
        f"prior: learned for other shapes than the rig has: {' and '.join(found)}; expected the same in the same order "
        "(prior.renamed(names) and adapt_dynamics(prior, names) translate those that have a pair)"
    )

"""Checks of a fit: landmarks that do not fit, photographs that do not show one person."""

import re
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchface.errors import AlignmentError
from torchface.landmarks import NoFaceError
from torchface.modeling import FitSettings, HeadModel, ImageFit
from torchface.modeling.photographs.fit_problem import ALIKE_IN_PICTURES
from torchface.modeling.photographs.landmark_view import JAW
from torchface.workflows.fit.color_evidence import color_evidence
from torchface.workflows.fit.fit_landmarks import PhotographLandmarks, find_in_photographs

MISFIT = 0.045
"""Of the eyes' distance: landmarks that lie further from the fit are remarked on; those found in three photographs
of people at most 2.4 % without the contour."""

ONE_PERSON, DOUBTED, OTHERS = 0.95, 0.25, 0.05
"""Probabilities by form and colours together: photographs above the first show one person, those below the last are
refused where the form alone speaks against it too; the second is of the form, below which colours take no doubt away.

Of 1,067 pairs of two of 26 people in photographs and films 13 % pass without a word, with the zoo's ``head`` and with
ICT's modes (29 and 33 % by form alone); 45 and 38 % are refused. Of 61 pairs of one person, of six people, none is
refused; 5 are warned of with ``head``, all of a tilted and a laughing face 90 pixels wide, none with ICT's.
"""

FORM_SAYS = 4.0
"""Most that like heads speak for one person, a logarithm of odds: other people have such heads too."""

ALONE = FitSettings(transfers=0, unknown_deviation=0.0, least_noise=0.004)
"""How heads are fitted for these checks, whose limits are of such fits: nothing but the model explains a head. Exact
landmarks, as of a rendered head, would be sure of coefficients that the model's form of it decides."""

NARROW, WIDE = -2.5, 3.5
"""Standard deviations of the heads' width beside their height: set by 24 real faces, which have -2.3 (seen from the
side) to 2.6."""

_NO_FACE_THERE = "finds no face where the given landmarks lie"
_NEAR = 0.5
_FOUND_EYES = 30.0  # pixels between the eyes' outer corners: of 18 faces in groups two smaller ones were not found

BareFit = Callable[[Tensor, list[int]], ImageFit]
"""Fits the template's shapes to landmarks (J,68,2) of photographs by their numbers, without skin."""


def eyes_distances(landmarks: Tensor) -> Tensor:
    """Between the outer corners of the eyes, (I,), of landmarks (I,68,2)."""
    return (landmarks[:, 36] - landmarks[:, 45]).norm(dim=-1)


def misfits(fit: ImageFit) -> Tensor:
    """The fit's errors in the eyes' distances, (I,)."""
    return fit.errors / eyes_distances(fit.landmarks)


def strange_lines(photographs: Sequence[Path], fit: ImageFit) -> list[str]:
    """Which found landmarks of the photographs' no head of the model explains, for people to read."""
    # A contour that a model cannot follow is the model's fault.
    inner = fit.residuals[:, JAW:].square().sum(-1).nanmean(1).sqrt() / eyes_distances(fit.landmarks)
    return [
        f"WARNING: {path.name}: found landmarks lie {misfit:.1%} of the eyes' distance from the nearest head, expected "
        f"less than {MISFIT:.1%}: an animal, a drawing, a mask, a grimace? The head may be nobody's"
        for path, misfit in zip(photographs, inner.tolist(), strict=True)
        if misfit > MISFIT
    ]


def width_lines(photographs: Sequence[Path], alone: Sequence[ImageFit], model: HeadModel, rows: Tensor) -> list[str]:
    """Which photographs, each fitted alone with a model's landmark vertices (68,), show a face too narrow or too wide
    for its height, for people to read."""
    mean, modes = (part[..., rows, :].double().cpu() for part in (model.shape.mean, model.shape.modes))
    around = mean - mean.mean(0)
    spread = (modes * around).sum(1) / around.square().sum(0)  # of each mode along x, y and z, (K,3)
    wider = (spread[:, 0] - spread[:, 1]) / (spread[:, 0] - spread[:, 1]).norm()
    lines = []
    for path, fit in zip(photographs, alone, strict=True):
        off = float(wider @ fit.coefficients.double())
        if not NARROW < off < WIDE:
            lines.append(
                f"WARNING: {path.name}: its face is {'wider' if off > 0 else 'narrower'} for its height than people's "
                f"are, by {abs(off):.1f} standard deviations of the head model's (expected {NARROW:g} to {WIDE:g}): "
                "was the picture squeezed or stretched? Give it in its own proportions"
            )
    return lines


def one_person_lines(
    photographs: Sequence[Path],
    marks: Tensor,
    alone: Sequence[ImageFit],
    bare: BareFit,
    insist: bool = False,
    colors: Tensor | None = None,
) -> list[str]:
    """Whether photographs that were fitted together show one person, for people to read; nothing if that is likely.
    Each is fitted alone too; colours (I,4) are those of ``part_colors``."""
    if len(photographs) < 2:
        return []
    sure, both = _likely(alone, colors)
    if not _doubtful(sure, both):
        return []
    joint = float(misfits(bare(marks, list(range(len(marks))))).square().mean().sqrt())
    each = float(torch.stack([misfits(fit)[0] for fit in alone]).square().mean().sqrt())
    listed, with_colors = (
        ", ".join(f"{path.name} {share:.0%}" for path, share in zip(photographs, shares.tolist(), strict=True))
        for shares in (sure, both)
    )
    colored = "" if colors is None else f", with the colours of hair, brows and lips {with_colors}"
    figures = (
        f"probability that each shows the person of the others, by the form of the heads {listed}{colored}, expected "
        f"above {ONE_PERSON:.0%}; landmarks lie {joint:.1%} of the eyes' distance from one head "
        f"for all, {each:.1%} from a head for each"
    )
    strangers, left, more = list[int](), list(range(len(photographs))), ""
    while len(left) > 1 and bool((others := (both < OTHERS) & (sure < 0.5)).any()):  # without the worst, the next one
        strangers.append(left.pop(int(both.where(others, torch.inf).argmin())))
        sure, both = _likely([alone[i] for i in left], None if colors is None else colors[left])
    if strangers and not insist:
        names = [", ".join(photographs[i].name for i in some) for some in (strangers, left)]
        one = len(strangers) == 1
        if len(left) > 1 and _doubtful(sure, both):
            more = f"; the others, {names[1]}, may show different people, too"
        raise AlignmentError(
            f"{names[0]}: {'shows another person' if one else 'show other people'} than the rest, or "
            f"{'its' if one else 'their'} landmarks are wrong{more} ({figures}); leave {'it' if one else 'them'} out, "
            "or --insist to fit them anyway"
        )
    return [f"WARNING: these photographs may show different people; their mean would be nobody ({figures})"]


def _likely(alone: Sequence[ImageFit], colors: Tensor | None) -> tuple[Tensor, Tensor]:
    """Probabilities (I,) that each shows the person of the others, by the form alone and with the colours (I,4)."""
    if len(alone) < 2:
        return torch.ones(len(alone)), torch.ones(len(alone))
    form = same_person(alone)
    both = form if colors is None else form.clamp(max=FORM_SAYS) + color_evidence(colors)
    return form.sigmoid(), both.sigmoid()


def _doubtful(sure: Tensor, both: Tensor) -> bool:
    return float(both.min()) < ONE_PERSON or float(sure.min()) < DOUBTED


def landmark_lines(
    photographs: Sequence[Path], images: Sequence[Tensor], marks: Tensor, finder: str | Path, bare: BareFit
) -> tuple[list[str], bool]:
    """Which given landmarks (I,68,2) of photographs (3,H,W) do not fit, and how those that are found do, for people
    to read; and whether some are not on a face: such a fit is poor, however near it comes.

    Of five photographs with the landmarks of each, the finder saw a face there in the five right pairs and in none of
    the 20 others.
    """
    lines, stray = [], False
    for i, misfit in enumerate(
        misfits(bare(marks, list(range(len(marks))))).tolist()
    ):  # photographs, which differ in size
        name = photographs[i].name
        reading, faces = _found_there(photographs[i], images[i], marks[i], finder)
        if misfit < MISFIT:
            large = float(eyes_distances(marks[i : i + 1])) >= _FOUND_EYES
            if faces and large and reading is None:
                stray = True
                lines.append(
                    f"WARNING: {name}: {finder} {_NO_FACE_THERE}, but {faces} elsewhere: are they of "
                    f"another photograph? Look at them in the image of the fit, or leave out --landmarks"
                )
            continue
        said = f"{name}: the given landmarks do not fit well, residual {misfit:.1%} of the eyes' distance"
        if reading is None:
            stray = True
            lines.append(
                f"WARNING: {said}, expected less than {MISFIT:.1%}; {finder} {_NO_FACE_THERE}: are they of another "
                f"photograph? Look at them in the image of the fit, or leave out --landmarks"
            )
            continue
        other = float(misfits(bare(reading.confident[None], [i]))[0])
        lines.append(
            ("WARNING: " if other < misfit else "")
            + f"{said}; those that {finder} finds have {other:.1%}; look at both in the images of the fit"
            + (", and leave out --landmarks to take the found ones" if other < misfit else "")
        )
    return lines, stray


def _found_there(
    photograph: Path, image: Tensor, marks: Tensor, finder: str | Path
) -> tuple[PhotographLandmarks | None, int]:
    """Found landmarks of the face that has given ones, and how many faces there are."""
    known = marks[torch.isfinite(marks).all(-1)]
    middle, size = known.mean(0), (known.amax(0) - known.amin(0)).amax()
    try:
        first = find_in_photographs([photograph], [image], finder)[0]
        centres = first.boxes[:, :2] + first.boxes[:, 2:] / 2
        distances = (centres.double() - middle).norm(dim=1)
        if float(distances.min()) > _NEAR * float(size):
            return None, len(centres)
        number = int(distances.argmin())
        there = number == first.number
        found = first if there else find_in_photographs([photograph], [image], finder, number)[0]
        return found, len(centres)
    except NoFaceError:
        return None, 0


def same_person(fits: Sequence[ImageFit]) -> Tensor:
    r"""The evidence that a photograph shows the head that the others show, and not any other.

    .. math:: \log \frac{p(q_i, q_{\ne i} \mid \text{one } a)}{p(q_i)\, p(q_{\ne i})}, \qquad a \sim N(0, I)

    with landmarks :math:`q` taken to be Gaussian about each fit's coefficients :math:`a`; 0 is no evidence. Errors that
    the others share, such as of a smile in all of them, are not known the better the more they are.

    Args:
        fits: one a photograph, each fitted alone with the same model, I of them.

    Returns:
        Natural logarithms of the odds, (I,) float64.

    Source: Prince, Elder 2007 (probabilistic linear discriminant analysis) for the ratio.
    """
    count = len(fits[0].coefficients)
    eye = torch.eye(count, dtype=torch.float64)
    precisions, pulls = [], []
    for fit in fits:  # photographs
        posterior = torch.linalg.inv(fit.covariance[:count, :count].double() + 1e-9 * eye)
        values, vectors = torch.linalg.eigh(0.5 * (posterior + posterior.T) - eye)
        precisions.append((vectors * values.clamp(min=0)) @ vectors.T)
        pulls.append(posterior @ fit.coefficients.double())
    information, pull = torch.stack(precisions), torch.stack(pulls)
    alike = 1 + ALIKE_IN_PICTURES * (len(fits) - 2)
    others, pulled = (information.sum(0) - information) / alike, (pull.sum(0) - pull) / alike
    return torch.stack([
        _log_evidence(one + more, own + by) - _log_evidence(one, own) - _log_evidence(more, by)
        for one, own, more, by in zip(information, pull, others, pulled, strict=True)
    ])  # fmt: skip


def counted(remarks: Sequence[str], frames: Collection[str]) -> list[str]:
    """Remarks of which those that differ in figures and the frame of a film alone are one, with their count."""
    alike = dict[str, list[str]]()
    for line in remarks:
        kind, _, rest = line.partition(": ")
        name, _, words = rest.partition(": ")
        same = re.sub(r"[\d.]+", "", kind + words) if name in frames else line
        alike.setdefault(same, []).append(line)
    return [
        lines[0] if len(lines) == 1 else lines[0].replace(": ", f": {len(lines)} of {len(frames)} frames, such as ", 1)
        for lines in alike.values()
    ]


def _log_evidence(precision: Tensor, pull: Tensor) -> Tensor:
    """Relative to landmarks that hold no evidence."""
    whole = precision + torch.eye(len(pull), dtype=torch.float64)
    return 0.5 * pull @ torch.linalg.solve(whole, pull) - 0.5 * torch.logdet(whole)

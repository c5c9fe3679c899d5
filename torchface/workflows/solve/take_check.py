"""Checks of a marker take against a rig and an attachment, which refuse or warn."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture.markers import FitCheck, MarkerSolver, check_fit
from torchface.capture.markers.cleaning.label_swaps import Swap, cycled_back, find_swaps, whole_take_exchanges
from torchface.capture.markers.cleaning.robust_prediction import predict_markers
from torchface.capture.markers.residual_pattern import residual_pattern
from torchface.capture.markers.rest_pose import check_not_collinear, inlier_markers
from torchface.capture.markers.take_alignment import align_take, rest_residual
from torchface.errors import AlignmentError, NameMismatchError
from torchface.escaped_text import listed
from torchface.geometry.meshes.operators import vertex_normals
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.workflows.marker_input import MAX_SCALE_DIFFERENCE

_COORDINATES = 3  # of a marker
_LABEL_FRAMES = 240
# A frame that moves the markers by so much more than the calmest frame is not neutral, mm.
MAX_NEUTRAL_MOTION = 1.0
# Sites of the same head differ by nothing; those of 16 heads drawn from ICT's identities by 0.6 to 5.6 mm.
MAX_REST_DISTANCE = 0.5
_MIN_PRESENT, _USUAL_PRESENT = 0.5, 0.9
_INSIST = "--insist writes the weights all the same"


@dataclass(frozen=True)
class Coverage:
    """The markers of an attachment that a take shows."""

    markers: int
    present: int  # of them, seen in some frame of the take
    shapes: int
    # Frames that show some markers, but fewer coordinates than the rig has shapes while most frames show more.
    poor: int

    @property
    def refused(self) -> bool:
        """Most of the markers are not there, and the rest have fewer coordinates than the rig has shapes."""
        return self._too_few and self.present < _MIN_PRESENT * self.markers

    @property
    def _too_few(self) -> bool:
        return _COORDINATES * self.present < self.shapes

    def warnings(self) -> list[str]:
        """For people to read."""
        lines = []
        if self._too_few or self.present < _USUAL_PRESENT * self.markers:
            blind = f"; too few for {self.shapes} shapes, many of which are guessed" if self._too_few else ""
            lines.append(f"the take shows {self.present} of the attachment's {self.markers} markers{blind}")
        if self.poor:
            lines.append(
                f"{self.poor} frames show fewer than {math.ceil(self.shapes / _COORDINATES)} markers: too few "
                f"for {self.shapes} shapes"
            )
        return lines


def check_coverage(attachment: Attachment, take: Take, shapes: int, insist: bool = False) -> Coverage:
    """Counts the attachment's markers in a take."""
    assert take.markers is not None
    labels = attachment.labels or ()
    known = take.markers.select([name for name in take.markers.names if name in labels])
    seen = ~torch.isnan(known.values).any(-1)
    count = seen.sum(1)
    enough = math.ceil(shapes / _COORDINATES)
    typical = float(count.double().median()) if len(count) else 0.0
    poor = int(((count > 0) & (count < enough)).sum()) if typical >= enough else 0
    points = known.values.double().nanmedian(0).values if len(known) else known.values.new_zeros(0, 3)
    points = points[torch.isfinite(points).all(-1)]
    if len(points) > 2:
        check_not_collinear(points, _source(take))
    coverage = Coverage(len(labels), int(seen.any(0).sum()), shapes, poor)
    if coverage.refused and not insist:
        missing = [label for label in labels if label not in known.names]
        raise NameMismatchError(
            f"{_source(take)}: found {coverage.present} of the attachment's {len(labels)} markers (not "
            f"{', '.join(missing[:4])}, ...), expected at least {min(enough, len(labels))} for {shapes} shapes; are "
            f"they called otherwise in the take (--labels map.csv)? {_INSIST}"
        )
    return coverage


def check_explained(solver: MarkerSolver, take: Take, aligned: bool, slip: bool, insist: bool = False) -> FitCheck:
    """How well a rig explains a take's markers, in rig space and known to the solver; with ``insist`` nothing is
    refused."""
    assert take.markers is not None
    markers = solver.arrange(take.markers).double()
    fit = check_fit(torch.cat([solver.rest[..., None], solver.every_basis], dim=2), markers, slip)
    fit = replace(fit, read_as=take.extras.get("unit"))
    if fit.refused and not insist:
        raise AlignmentError(
            f"{_source(take)}: the rig brings the marker sites no nearer to the markers than {fit.distance:.4g} mm "
            f"(median), expected at most {fit.limit:.2g} mm; {_cause(fit, aligned, slip)}; {_INSIST}"
        )
    return fit


def fit_warnings(fit: FitCheck, aligned: bool, slip: bool) -> list[str]:
    """Warnings for a take that the rig explains badly; none for one that it explains."""
    if not fit.cause:
        return []
    return [
        f"the rig brings the marker sites no nearer to the markers than {fit.distance:.4g} mm (median); "
        f"{_cause(fit, aligned, slip)}"
    ]


def check_head(
    rig: BlendshapeRig, attachment: Attachment, take: Take, insist: bool = False, cause: str = ""
) -> tuple[list[str], list[str]]:
    """Warnings where rig, attachment and take do not belong to one head, by the residual of the take; and the markers
    that lie off their sites in the whole take, which alone are no warning."""
    warnings: list[str] = []
    distance = attachment.rest_distance(rig.neutral)
    if distance > MAX_REST_DISTANCE:
        why = (
            f"the attachment was made for another head: its sites at rest lie {distance:.2g} mm from this rig's "
            f"(median), expected at most {MAX_REST_DISTANCE} mm; find this head's own from a range of motion "
            "(torchface attach --initial)"
        )
        if not insist:
            raise AlignmentError(f"{_source(take)}: {why}; {_INSIST}")
        warnings.append(why)
    assert take.markers is not None
    few = take.markers.frames(slice(None, None, max(1, len(take) // _LABEL_FRAMES)))
    if bool(torch.isnan(few.values).any(-1).all()):
        return warnings, []
    residual = _left_at_rest(rig, attachment, few)
    faces, rest = rig.neutral.faces, rig.vertices.detach()
    normals = attachment.on(faces, vertex_normals(rest, faces))
    pattern = residual_pattern(residual, attachment.on(faces, rest), normals)
    if pattern.other_head and cause in ("", "attachment"):
        warnings.append(
            f"what is left at rest is smooth over the face ({pattern.smooth:.2g} mm, correlation of neighbours "
            f"{pattern.correlation:.2f}): the rig is most likely another head's; weights will be wrong"
        )
    astray, labels, values = list[str](), attachment.labels or (), few.values.clone()
    while len(astray) < len(labels) / 2:  # one that is far off draws its neighbours: without it, the next one
        off = residual.norm(dim=-1)
        worst = int(off.argmax())
        if bool(inlier_markers(off)[worst]):
            break
        astray.append(f"{labels[worst]} {float(off[worst]):.1f} mm")
        values[:, few.names.index(labels[worst])] = torch.nan
        residual = _left_at_rest(rig, attachment, Track(few.names, values))
    return warnings, astray


def _left_at_rest(rig: BlendshapeRig, attachment: Attachment, markers: Track) -> Tensor:
    """What is left at rest beyond the attachment's own residual, (M,3), millimetres; 0 where nothing is seen."""
    residual = rest_residual(rig, attachment, Take(60.0, markers=markers)).residual
    assert residual is not None
    return residual if attachment.residual is None else residual - attachment.residual


def neutral_warnings(rig: BlendshapeRig, attachment: Attachment, take: Take, frame: int, scale: bool) -> list[str]:
    """Warnings where a frame that is given as neutral moves the face more than the calmest frame of its take."""
    assert take.markers is not None
    rows = torch.arange(0, len(take), max(1, len(take) // _LABEL_FRAMES))
    rows = torch.cat([rows, torch.tensor([frame])])
    few = take.markers.frames(rows)
    seen = (~torch.isnan(few.values).any(-1)).any(1)
    if not bool(seen[-1]):
        return []
    few, rows = few.frames(seen), rows[seen]
    alignment = align_take(rig, attachment, Take(take.fps, markers=few), insist=True, scale=scale)
    solver = MarkerSolver(rig, attachment, alignment)
    weights = solver(solver.arrange(few).double())
    motion = (solver.points(weights) - solver.points(torch.zeros_like(weights[:1]))).norm(dim=-1)
    size = motion.square().mean(1).sqrt()
    calmest = int(size[:-1].argmin()) if len(size) > 1 else 0
    if float(size[-1]) <= float(size[calmest]) + MAX_NEUTRAL_MOTION:
        return []
    strongest = [rig.names[i] for i in weights[-1].argsort(descending=True)[:3].tolist()]
    number, calm = (int(take.numbers[row]) for row in (frame, rows[calmest]))
    return [
        f"frame {number} is not at rest: the face moves the markers by {float(size[-1]):.2g} mm there "
        f"({', '.join(strongest)}), by {float(size[calmest]):.2g} mm in frame {calm}: take that for "
        "--neutral, or --align in its place"
    ]


def label_warnings(solver: MarkerSolver, take: Take, slip: bool) -> list[str]:
    """Warnings for labels that are exchanged in the whole take or in part of it; for takes that are not cleaned."""
    assert take.markers is not None
    step = max(1, len(take) // _LABEL_FRAMES)
    few, numbers = solver.arrange(take.markers).double()[::step], take.numbers[::step].tolist()
    prediction = predict_markers(solver, few, slip)
    lines = []
    for cycle in (cycles := whole_take_exchanges(few, prediction)):
        distance = float(prediction.distance[:, list(cycle)].nanmedian())
        names = " and ".join(solver.labels[m] for m in cycle)
        lines.append(
            f"the labels {names} seem to be exchanged in the whole take: the markers lie {distance:.3g} mm from their "
            "own sites, and on each other's; --clean exchanges them"
        )
    if cycles:
        few = cycled_back(few, cycles)
        prediction = predict_markers(solver, few, slip)
    stretches: dict[tuple[int, int], list[Swap]] = {}
    for swap in find_swaps(few, prediction, 1.0):
        stretches.setdefault(swap.markers, []).append(swap)
    for (a, b), swaps in stretches.items():
        count = sum(swap.last - swap.first for swap in swaps)
        spans = listed(f"{numbers[swap.first]}–{numbers[swap.last - 1]}" for swap in swaps)
        lines.append(
            f"the labels {solver.labels[a]} and {solver.labels[b]} are exchanged in about "
            f"{100 * count / len(few):.0f} % of the frames ({spans}): --clean exchanges them back"
        )
    return lines


def _cause(fit: FitCheck, aligned: bool, slip: bool) -> str:
    if fit.cause == "motion":
        assert fit.motion is not None
        advice = " ".join(flag for flag, given in (("--align", aligned), ("--slip", slip)) if not given)
        return (
            f"the head moves in the volume, by up to {fit.motion.extent()}; without this motion {fit.corrected:.2g} mm "
            f"are left: add {advice}"
        )
    if fit.cause == "unit":
        assert fit.similarity is not None
        factor = float(fit.similarity.scale[0])
        sizes = f"{factor:.4g} times larger" if factor > 1 else f"{1 / factor:.4g} times smaller"
        space = "--align if it is not in the rig's space"
        if fit.motion is not None:
            space = "--align --slip, as the head moves in the volume"
        names = {"m": "metres", "cm": "centimetres", "in": "inches", "mm": "millimetres", "um": "micrometres"}
        return (
            f"{sizes} they lie {fit.corrected:.2g} mm from it, so the take seems to be in {names[fit.unit]}: add "
            f"--unit {fit.unit}, and {space}"
        )
    if fit.cause == "alignment":
        assert fit.similarity is not None
        factor = float(fit.similarity.scale[0])
        if aligned and abs(factor - 1) > MAX_SCALE_DIFFERENCE:
            return f"at {factor:.4g} times its size the take lies {fit.corrected:.2g} mm from it: add --scale free"
        advice = "the frame of --neutral is not at rest: --align does without one" if aligned else "add --align"
        return (
            f"aligned with the rig they lie {fit.corrected:.2g} mm from it, so the take is in another space: {advice}"
        )
    if fit.cause == "mirror":
        return (
            f"mirrored and aligned with the rig they lie {fit.corrected:.2g} mm from it, so the coordinates are "
            "left-handed (add --flip x, y or z, or leave it out if it is given; --align if the take is not in the "
            "rig's space), or the labels of left and right are swapped (--labels)"
        )
    if fit.cause == "slip":
        return f"without the motion of the helmet against the head {fit.corrected:.2g} mm are left: add --slip"
    tried = (
        "the take is aligned with the rig" if aligned else "turning, moving and scaling the take does not help enough"
    )
    return (
        f"{tried}, so the attachment or the rig is another one's, or labels are mixed up: look at the sites "
        "(torchface view), find them anew (torchface attach)"
    )


def _source(take: Take) -> str:
    return str(take.extras.get("source", "take"))

"""From a rig, a range-of-motion take and a first guess on disk to marker sites on disk."""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchface.attachment import Attachment
from torchface.capture import MarkerSolver, align_take, clean_take, fit_attachment
from torchface.capture.markers import AttachmentFit, Cleanup, Defect, check_attachment, sites_by_shape
from torchface.capture.markers.attachment.attachment_fit import marker_paths
from torchface.capture.markers.attachment.initial_sites import crossed_sides
from torchface.capture.markers.cleaning.label_swaps import find_swaps_by_shape, swapped_back
from torchface.capture.markers.helmet_motion import steady_take
from torchface.capture.markers.rest_pose import check_not_mirrored, inlier_markers
from torchface.errors import AlignmentError, FileFormatError, ValueRangeError
from torchface.escaped_text import listed
from torchface.files.content_keys import content_key
from torchface.files.whole_files import all_or_none, check_ending, check_writable, make_folder
from torchface.io import load_landmarks, load_rig
from torchface.mesh import Mesh
from torchface.progress import Progress, silent
from torchface.rendering.compositing import PICTURE_ENDINGS, save_rendered_image, sheet
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.viz import site_views
from torchface.viz.figures.marker_maps import errors_by_iteration
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.batch.contact_sheet import small_picture
from torchface.workflows.batch.outcomes import RESULT, Made, word_of
from torchface.workflows.marker_input import (
    DEFAULT_OPTIONS,
    MARKER_TAKES,
    MarkerOptions,
    read_range_of_motion,
    scale_warnings,
)

MOTIONS = replace(MARKER_TAKES, done="attached")

_METHOD = "attach batch/3"
# A marker of which more is masked is not cleaned: what is wrong with it is said.
_MAX_MASKED = 0.5
# A common distance from the skin is advised where it leaves less than this part of the markers' error.
_STANDOFF_RATIO = 0.95
# One marker in so many may sit on the helmet.
_MAX_HELMET = 3
_STILL = 0.5  # of most markers' motion, as recorded, which is the head's too
_INSIST = "--insist writes the sites all the same"
_BY_SHAPE = (
    "found by the markers' shape alone, to which a take in left-handed axes looks the same: see on which side they lie "
    "(--picture), or say it roughly (--initial)"
)
_SETTLED = 1.0  # millimetres: where most markers stay so near to their sites, the pose was found


@dataclass(frozen=True, eq=False)
class AttachReport:
    """What came of a range of motion."""

    fit: AttachmentFit  # the sites and how they were found
    moved: Tensor  # how far each marker's site is from the first guess, (M,), millimetres
    cleanup: Cleanup  # what was wrong with the take
    warnings: tuple[str, ...] = ()  # what the user should know before they use the sites
    remarks: tuple[str, ...] = ()  # what else there is to say
    refused: bool = False  # whether the sites are written only because the user insists

    def verdict(self) -> str:
        """Whether the sites are to be used, in a line."""
        last, open_sites = self.fit.errors[-1], len(self.fit.uncertainty.markers)
        worst = (self.fit.attachment.labels or ())[int(last.argmax())]
        lie = (
            f"the markers lie {float(last.mean()):.2f} mm from their sites (mean over the markers; the worst, {worst}, "
            f"{float(last.max()):.2f} mm)"
        )
        if self.refused:
            return f"result: poor, {lie}; written as --insist says, see the warning"
        if open_sites:
            return f"result: partly usable, {open_sites} of {len(last)} sites are uncertain, see below; {lie}"
        if self.warnings:
            return f"result: partly usable, see the warning; {lie}"
        return f"result: good, {lie}"

    def lines(self) -> list[str]:
        """For people to read."""
        first, last = self.fit.errors[0], self.fit.errors[-1]
        labels = self.fit.attachment.labels or ()
        worst = int(last.argmax())
        lines = [
            f"{len(labels)} markers over {len(self.fit.weights)} frames, {len(self.fit.errors)} iterations",
            f"sites moved by {float(self.moved.mean()):.1f} mm on average, by {float(self.moved.max()):.1f} mm at most",
            f"marker error: mean {float(first.mean()):.2f} mm at first, {float(last.mean()):.2f} mm in the end; "
            f"worst {labels[worst]}, {float(last[worst]):.2f} mm",
        ]
        if self.fit.standoff:
            lines.append(f"markers stand {self.fit.standoff:.2f} mm above the skin")
        if self.fit.motion is not None:
            lines.append(f"helmet or head: moved by up to {self.fit.motion.extent()}; solved along")
        if self.cleanup.defects:
            lines.append(f"cleanup: {self.cleanup.summary()}")
        warnings = [f"warning: {warning}" for warning in self.warnings]
        return [self.verdict(), *warnings, *lines, *self.remarks, *self._uncertain()]

    def _uncertain(self) -> list[str]:
        """What the take leaves open."""
        uncertainty = self.fit.uncertainty
        shapes = [
            f"{name} (±{float(uncertainty.levels[uncertainty.names.index(name)]):.2f})" for name in uncertainty.shapes
        ]
        sites = [
            f"{label} (±{float(uncertainty.sites[uncertainty.labels.index(label)]):.1f} mm)"
            for label in uncertainty.markers
        ]
        lines = []
        if sites:
            lines.append(f"sites that the take leaves uncertain, kept near the first guess: {listed(sites)}")
        if shapes:
            lines.append(
                f"shapes whose level the take leaves uncertain: {listed(shapes)}; play them strongly, each by itself"
            )
        if uncertainty.unseen:
            lines.append(f"shapes that these markers hardly see: {listed(uncertainty.unseen)}")
        return lines


def load_sites(path: Path, mesh: Mesh, owner: str | Path = "the mesh") -> Attachment:
    """A first guess of marker sites: an attachment, or labelled vertices, as ``torchface pick`` writes both."""
    try:
        sites = Attachment.load(path)
    except FileFormatError as error:
        try:
            picked = load_landmarks(path)
        except FileFormatError:
            raise error from None
        picked.check(mesh)
        return Attachment.from_vertices(mesh, picked.vertices, picked.labels)
    sites.check(mesh, path, owner)
    return sites


def cleaned_fit(
    rig: BlendshapeRig,
    take: Take,
    start: Attachment,
    standoff: bool,
    progress: Progress | None = None,
    free_scale: bool = True,
) -> tuple[AttachmentFit, Cleanup]:
    """Sites from a range of motion that may have swapped labels, spikes and markers that drift: fitted, and where
    something is wrong with the take cleaned with these sites and fitted again. What does not fit is not refused.
    """
    progress = progress or silent
    take, swaps = _in_order(take)
    fit = fit_attachment(rig, take, start, standoff, progress, insist=True, scale=free_scale)
    progress("looking for what is wrong with the take")
    cleanup = clean_take(MarkerSolver(rig, fit.attachment, fit.alignment), take, slip=fit.motion is not None)
    if any(defect.kind != "gap" for defect in cleanup.defects):
        fit = fit_attachment(rig, _usable(cleanup, take), start, standoff, progress, insist=True, scale=free_scale)
    defects = sorted((*swaps, *cleanup.defects), key=lambda defect: (defect.first, defect.kind, defect.labels))
    return fit, replace(cleanup, defects=tuple(defects))


def helmet_markers(fit: AttachmentFit, steady: Take, recorded: Take) -> list[str]:
    """The labels of markers that stay far from the skin and move no more than most of the others: the helmet's.

    They do so once the head's motion is taken out; or as recorded less than half as much, where the helmet slips and
    stays where it is. At most a third of all: else it is the rig or the labels that are wrong.
    """
    labels, on_skin = fit.attachment.labels or (), inlier_markers(fit.errors[-1])
    still = torch.zeros_like(on_skin)
    for take, share in ((steady, 1.0), (recorded, _STILL)):
        assert take.markers is not None
        paths = take.markers.select(labels).values.double()
        motion = (paths - paths.nanmedian(0).values).square().sum(-1).nanmean(0).sqrt()
        still |= motion <= share * motion[on_skin].median()
    far = (~on_skin & still).nonzero()[:, 0].tolist()
    return [labels[m] for m in far] if _MAX_HELMET * len(far) <= len(labels) else []


def _in_order(take: Take) -> tuple[Take, list[Defect]]:
    """A take with the labels exchanged back that its own shape shows to be exchanged; there are no sites yet."""
    assert take.markers is not None
    names, values = take.markers.names, take.markers.values
    swaps = find_swaps_by_shape(values.double(), take.fps)
    defects = []
    for swap in swaps:
        apart = values[swap.first : swap.last, swap.markers[0]] - values[swap.first : swap.last, swap.markers[1]]
        size = float(apart.norm(dim=-1).nan_to_num(0.0).max())
        labels = (names[swap.markers[0]], names[swap.markers[1]])
        defects.append(Defect("swap", labels, swap.first, swap.last - 1, size, "swapped back"))
    return replace(take, markers=Track(names, swapped_back(values, swaps), take.markers.confidence)), defects


def _standoff_hint(
    rig: BlendshapeRig, take: Take, start: Attachment, settings: "AttachSettings", fit: AttachmentFit
) -> str:
    """Advice where sites do not explain a take and a common distance from the skin, which was not asked for, does."""
    if settings.standoff or settings.options.scale == "free":
        return ""
    lifted = fit_attachment(rig, take, start, standoff=True, insist=True, scale=False)
    better = float(lifted.errors[-1].median()) < _STANDOFF_RATIO * float(fit.errors[-1].median())
    return f"; the markers stand {lifted.standoff:.1f} mm off the skin: add --standoff" if better else ""


def _usable(cleanup: Cleanup, take: Take) -> Take:
    """The cleaned take; markers of which most would be gone as they were."""
    assert cleanup.take.markers is not None
    assert take.markers is not None
    seen = ~torch.isnan(take.markers.values).any(-1)
    lost = (cleanup.masked & seen).sum(0) > _MAX_MASKED * seen.sum(0)
    values = torch.where(lost[:, None], take.markers.values, cleanup.take.markers.values)
    return replace(take, markers=Track(take.markers.names, values, take.markers.confidence))


@dataclass(frozen=True)
class AttachSettings:
    """How marker sites are found on a rig."""

    initial: Path | None = None  # a file of sites to begin from; found by the markers' shape if absent
    standoff: bool = False  # find how far the markers' centres lie above the skin
    part: str | None = None  # an annotated region that the rig is cut to, such as "face"
    options: MarkerOptions = DEFAULT_OPTIONS  # how the take's markers are read
    # Write the sites although the rig does not explain the markers, or the take leaves most uncertain.
    insist: bool = False


def attach(
    rig: Path,
    rom: Path,
    out: Path,
    settings: AttachSettings = AttachSettings(),
    picture: Path | None = None,
    progress: Progress | None = None,
) -> AttachReport:
    """Reads, finds the sites, writes them, and a picture where one is wanted; see ``torchface attach --help``."""
    progress = progress or silent
    check_writable(out, picture)
    if picture is not None:
        check_ending(picture, *PICTURE_ENDINGS)
    progress("reading the rig")
    loaded = load_rig(rig, part=settings.part)
    progress("reading the range of motion")
    start = None if settings.initial is None else load_sites(settings.initial, loaded.neutral, rig)
    take, start, notes = read_range_of_motion(rom, start, settings.options)
    recorded = take
    take, head = steady_take(take)
    remarks: list[str] = []
    if start is None:
        progress("looking for the pose in which the markers lie on the face")
        start = sites_by_shape(loaded, take)
        crossed = crossed_sides(start, loaded)
        if crossed and not settings.insist:
            raise AlignmentError(f"{rom}: {crossed}; {_INSIST}")
        notes += [crossed] if crossed else []
        remarks = [_BY_SHAPE] if crossed is None else []
    elif not settings.insist:
        sites = start.on(loaded.neutral.faces, loaded.vertices)
        check_not_mirrored(marker_paths(take, start), sites, str(rom), take.extras.get("flipped"))
    free_scale = settings.options.frees_scale(rom)
    fit, cleanup = cleaned_fit(loaded, take, start, settings.standoff, progress, free_scale)
    on_helmet = helmet_markers(fit, take, recorded)
    if on_helmet:
        names = [name for name in fit.attachment.labels or () if name not in on_helmet]
        assert take.markers is not None
        take, start = replace(take, markers=take.markers.select(names)), start.select(names)
        notes.append(f"left out {listed(on_helmet)}: far from the skin and still, as markers of the helmet are")
        fit, cleanup = cleaned_fit(loaded, take, start, settings.standoff, progress, free_scale)
    free = fit.alignment
    if not free_scale:
        fitted = fit.attachment if settings.standoff else replace(fit.attachment, residual=None)
        free = align_take(loaded, fitted, take, insist=True)
    notes = [*notes, *scale_warnings(float(free.scale[0]), not free_scale, take.extras.get("unit"))]
    if head is not None:
        motion = head.moved_by(fit.alignment)
        fit = replace(fit, motion=motion if fit.motion is None else motion.after(fit.motion))
    refused = False
    try:
        check_attachment(fit, loaded)
    except (AlignmentError, ValueRangeError) as error:
        why = f"{error}{_standoff_hint(loaded, take, start, settings, fit)}"
        astray = isinstance(error, ValueRangeError) or float(fit.errors[-1].median()) > _SETTLED
        if settings.initial is None and astray:
            why += ", or the markers' shape alone does not show where they sit: --initial says it roughly"
        if not settings.insist:
            raise type(error)(f"{rom}: {why}; {_INSIST}") from None
        notes, refused = [*notes, why], True
    faces, vertices = loaded.neutral.faces, loaded.vertices
    before, after = start.on(faces, vertices), fit.attachment.on(faces, vertices)
    progress("writing")
    make_folder(out.parent)
    with all_or_none():
        fit.attachment.save(out)
        if picture is not None:
            views = [site_views(loaded.neutral, before, after), errors_by_iteration(fit.errors)]
            save_rendered_image(sheet(views, 1), picture)
    moved = torch.linalg.vector_norm(after - before, dim=1)
    return AttachReport(fit, moved, cleanup, tuple(notes), tuple(remarks), refused)


@dataclass(frozen=True)
class MotionJob:
    """How the sites of each take are found; ``{name}`` in a path is the take's name."""

    # rig, settings: see attach
    rig: Path
    settings: AttachSettings

    def key(self, item: BatchItem) -> str:
        """A key of all that the sites depend on."""
        return content_key(_METHOD, take=item.path, settings=item.settings_of(self))

    def run(self, item: BatchItem, out: Path) -> Made:
        """Finds the sites of a take and writes ``NAME.json`` and a picture of them, ``NAME.png``."""
        job, sites, picture = item.settings_of(self), out / f"{item.name}.json", out / f"{item.name}.png"
        done = attach(job.rig, item.path, sites, job.settings, picture)
        last = done.fit.errors[-1]
        error = float(torch.as_tensor(last).mean())
        return Made(
            (sites, picture),
            {
                RESULT: word_of(done.verdict()),
                "error_mm": error,
                "worst_mm": float(last.max()),
                "markers": len(done.fit.attachment.triangles),
                "frames": len(done.fit.weights),
                "iterations": len(done.fit.errors),
            },
            f"{error:.2f} mm",
            done.warnings,
            small_picture(picture),
        )

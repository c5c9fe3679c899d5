"""A rig from a neutral head alone, by an expression regression beside deformation transfer, with a report of both."""

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from torchface.errors import TopologyError
from torchface.files.job_lock import file_lock
from torchface.files.whole_files import all_or_none
from torchface.io import load_mesh, load_rig, save_rig
from torchface.modeling import NeutralRig, neutral_notes, neutral_rig
from torchface.progress import Progress, silent
from torchface.rendering.clay_shading import render
from torchface.rendering.compositing import caption, sheet
from torchface.synthetic import performer
from torchface.viz.figures.error_maps import error_colors, round_maximum
from torchface.viz.figures.face_views import clay_colors, color_bar, frame_face
from torchface.viz.reports.report_page import Section, Table, write_page
from torchface.workflows.rig.actor_rig import RigOptions, check_out, load_expressions
from torchface.workflows.rig_names import renamed

EXPRESSIONS = "expressions"
"""The zoo's model, where none is named."""
REPORT_ENDING = "_shapes"
"""Ends the name of the report's folder beside a rig."""
_PICTURED, _HEIGHT = 6, 300


@dataclass(frozen=True, eq=False)
class PredictedRig:
    """A written rig, why each shape is what it is, and the report's page."""

    made: NeutralRig
    model: str
    page: Path
    notes: tuple[str, ...]  # on a head that is likely not at rest

    def verdict(self) -> str:
        """Whether the rig is to be used, in a line."""
        word = "partly usable, see the warning" if self.notes else "good"
        learned, shapes = int(self.made.learned.sum()), len(self.made.rig.names)
        return f"result: {word}, {shapes} shapes, {learned} of them predicted by {self.model}"

    def lines(self) -> list[str]:
        """For people to read."""
        made = self.made
        learned, known = int(made.learned.sum()), int(made.known.sum())
        unsure = [name for name, row in zip(made.rig.names, made.known & ~made.learned, strict=True) if row]
        line = f"rig: {len(made.rig.vertices)} vertices; of {len(made.rig.names)} shapes {learned} predicted by "
        line += f"{self.model}, {len(made.rig.names) - learned} transferred"
        lines = [self.verdict(), *(f"warning: {note}" for note in self.notes), line]
        if unsure:
            lines.append(
                f"  transferred though {self.model} knows them, its error would be larger: {', '.join(unsure)}"
            )
        if known and not bool(made.expected.isfinite().any()):
            lines.append(f"  {self.model} was trained without a comparison: none of its {known} shapes was judged")
        else:
            lines.append(f"  the head's distance from the people learned from: {made.distance:.1f} (theirs: about 1.4)")
        return [*lines, f"report: {self.page}"]


def predict_rig(
    head: Path,
    out: Path,
    expressions: str | Path = EXPRESSIONS,
    template: Path | None = None,
    options: RigOptions | None = None,
    progress: Progress | None = None,
) -> PredictedRig:
    """Makes a rig of a head in the topology of a template or the embedded performer, by a regression, and writes it,
    with a report ``NAME_shapes/index.html``."""
    options, progress = options or RigOptions(), progress or silent
    check_out(out)
    with file_lock(out):
        progress("reading the template")
        source = performer(texture=False) if template is None else load_rig(template, part=options.part)
        model = load_expressions(expressions, source, template)
        neutral = load_mesh(head, options.unit)
        wanted = source.neutral.fingerprint()
        if neutral.fingerprint() != wanted:
            raise TopologyError(
                f"{head}: found topology {neutral.fingerprint()}, expected the template's, {wanted} (vertices, hash "
                "of the triangles); `torchface rig HEAD --template RIG` registers a head of another one, as a scan"
            )
        progress("predicting shapes")
        made = neutral_rig(model, source, neutral)
        notes = neutral_notes(source, neutral)
        progress("writing the rig")
        name, report = Path(expressions).name, out.with_name(f"{out.stem}{REPORT_ENDING}")
        with all_or_none():
            save_rig(renamed(made.rig, options.names), out)
            page = write_page(report, f"Shapes of {out.stem}", _sections(made, name))
        return PredictedRig(made, name, page, notes)


def _sections(made: NeutralRig, model: str) -> list[Section]:
    apart = (made.rig.deltas - made.transferred.deltas).norm(dim=-1)
    prediction, transfer = made.expected.tolist()
    rows = []
    for i, name in enumerate(made.rig.names):
        why = "predicted" if made.learned[i] else "transferred: unsure" if made.known[i] else "transferred"
        moved = float(made.rig.deltas[i].norm(dim=-1).max())
        rows.append((name, why, *(f"{x:.2f}" for x in (prediction[i], transfer[i], moved, float(apart[i].max())))))
    heading = ("shape", "by", f"{model} expects", "transfer", "moves up to", "apart by up to")
    text = (
        "Errors are root mean squares over all vertices, millimetres, as measured on people left out in training; the "
        "model's grows with the head's distance from those learned from, here "
        f"{made.distance:.2f}. A shape is transferred where the model's error would be the larger one (unsure), or "
        "where it does not know the shape."
    )
    sections = [Section("Shapes", text, [Table(heading, [[c.replace("nan", "-") for c in row] for row in rows])])]
    shown = [i for i in apart.amax(1).argsort(descending=True).tolist() if made.learned[i]][:_PICTURED]
    if shown:
        text = "Transferred, predicted, and the distance between both, for the shapes that differ most."
        sections.append(Section("Side by side", text, figures=[("shapes.png", _pictures(made, apart, shown))]))
    return sections


def _pictures(made: NeutralRig, apart: Tensor, shown: list[int]) -> Tensor:
    neutral = made.rig.neutral
    camera = frame_face(neutral, width=_HEIGHT * 4 // 5, height=_HEIGHT)
    clay, worst = clay_colors(neutral), round_maximum(float(apart[shown].max()))
    views = []
    for i in shown:
        for title, rig, colors in (
            ("transferred", made.transferred, clay),
            ("predicted", made.rig, clay),
            ("apart", made.rig, error_colors(apart[i], worst, "turbo")),
        ):
            face = neutral.with_vertices((neutral.vertices + rig.deltas[i]).detach())
            views.append(caption(render(face, camera, colors), f"{made.rig.names[i]}: {title}", 12))
    table = sheet(views, 3)
    return sheet([table, color_bar(worst, "apart (mm)", _HEIGHT)], 2)

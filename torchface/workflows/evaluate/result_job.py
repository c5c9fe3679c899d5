"""One result of many, compared with its truth from file to file."""

from dataclasses import dataclass, field
from pathlib import Path

from torchface.errors import FileFormatError
from torchface.files.content_keys import content_key
from torchface.viz.figures.error_maps import error_colors
from torchface.workflows.animated_meshes import is_animation
from torchface.workflows.batch.batch_items import SCAN_ENDINGS, BatchItem, ItemKind
from torchface.workflows.batch.contact_sheet import face_picture
from torchface.workflows.batch.outcomes import Made
from torchface.workflows.evaluate.compare_with_truth import EvaluationSettings, evaluate
from torchface.workflows.evaluate.evaluate_page import write_evaluation_page
from torchface.workflows.evaluate.evaluation_record import ALL

RESULTS = ItemKind("result", "compared", (".csv", ".safetensors", *SCAN_ENDINGS), is_animation)
_METHOD = "evaluate batch/2"
_SHEET_MAXIMUM = 1.0  # millimetres; the same for all, which lie side by side


@dataclass(frozen=True)
class ResultJob:
    """How each result is compared; ``{name}`` in a path is the result's name."""

    truth: Path  # of all results, or a folder that holds one of each result's name
    settings: EvaluationSettings = field(default_factory=EvaluationSettings)  # see evaluate
    height: int = 290  # of each view of a face in the reports, pixels

    def key(self, item: BatchItem) -> str:
        """A key of all that a comparison depends on."""
        try:
            truth: Path | None = self._truth(item)
        except FileFormatError:
            truth = None
        return content_key(
            _METHOD, result=item.path, truth=truth, own=item.settings_of(self.settings), height=self.height
        )

    def run(self, item: BatchItem, out: Path) -> Made:
        """Compares a result with its truth and writes the folder ``NAME``."""
        folder = out / item.name
        evaluation = evaluate(item.path, self._truth(item), folder, item.settings_of(self.settings))
        page = write_evaluation_page(evaluation, folder, self.height)
        whole = evaluation.regions[ALL]
        return Made(
            (folder / "summary.json", page),
            {
                "mean_mm": whole.mean,
                "median_mm": whole.median,
                "p95_mm": whole.percentile_95,
                "largest_mm": whole.largest,
                "frames": len(evaluation.frames),
            },
            f"{whole.mean:.3f} mm",
            picture=face_picture(
                evaluation.mesh, error_colors(evaluation.vertex_mean, self.settings.maximum or _SHEET_MAXIMUM)
            ),
        )

    def _truth(self, item: BatchItem) -> Path:
        truth = item.path_of(self.truth)
        if not truth.is_dir() or is_animation(truth):
            return truth
        named = sorted(path for path in truth.iterdir() if path.stem == item.path.stem and is_animation(path))
        if len(named) != 1:
            found = ", ".join(path.name for path in named) or "none"
            raise FileFormatError(f"{truth}: found {found} for {item.path.name}, expected one truth of its name")
        return named[0]

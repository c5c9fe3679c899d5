"""One marker take of many, solved from file to file."""

from dataclasses import dataclass
from pathlib import Path

import torch

from torchface.files.content_keys import content_key
from torchface.workflows.batch.batch_items import BatchItem
from torchface.workflows.batch.batch_job import model_content
from torchface.workflows.batch.contact_sheet import face_picture
from torchface.workflows.batch.outcomes import RESULT, Made, word_of
from torchface.workflows.marker_input import DEFAULT_OPTIONS, MarkerOptions
from torchface.workflows.solve.head_camera import HeadCamera
from torchface.workflows.solve.solution import SolveSettings
from torchface.workflows.solve.solve_take import TakeInputs, TakeOutputs, solve_take

_METHOD = "solve/3"


@dataclass(frozen=True)
class TakeJob:
    """How each take is solved; ``{name}`` in a path is the take's name."""

    # rig, attachment: see `solve_take`
    rig: Path
    attachment: Path
    # settings, part, camera, options: see `solve_take`
    settings: SolveSettings
    options: MarkerOptions = DEFAULT_OPTIONS
    part: str | None = None
    camera: HeadCamera | None = None
    # animation, report, live_link: what is to be written of each besides the weights, and where
    animation: Path | None = None
    report: Path | None = None
    live_link: Path | None = None
    reduce: float | None = None  # see `WeightFiles`

    def key(self, item: BatchItem) -> str:
        """A key of all that the take's weights depend on."""
        camera = None if self.camera is None else item.settings_of(self.camera)
        return content_key(
            _METHOD,
            take=item.path,
            rig=item.path_of(self.rig),
            attachment=item.path_of(self.attachment),
            settings=self.settings,
            part=self.part,
            camera=camera,
            watched=None if camera is None else [camera.labels_file, model_content(camera.classifier)],
            options=item.settings_of(self.options),
            written=[str(path) for path in (self.animation, self.report, self.live_link)],
            reduce=self.reduce,
        )

    def run(self, item: BatchItem, out: Path) -> Made:
        """Solves a take and writes ``NAME.csv``."""
        camera = None if self.camera is None else item.settings_of(self.camera)
        files = item.path_of(self.rig), item.path, item.path_of(self.attachment)
        inputs = TakeInputs(*files, self.part, camera, item.settings_of(self.options))
        weights, report = out / f"{item.name}.csv", item.path_of(self.report)
        animation, live_link = item.path_of(self.animation), item.path_of(self.live_link)
        outputs = TakeOutputs(weights, animation, live_link, self.reduce, report)
        done = solve_take(inputs, outputs, self.settings)
        solution = done.solution
        rig, values, rmse = solution.rig, solution.weights, solution.rmse
        strongest = values[values.norm(dim=1).argmax()].to(rig.deltas)
        with torch.no_grad():
            picture = face_picture(rig.neutral.with_vertices(rig(strongest[None])[0]))
        median = float(rmse.nanmedian())
        return Made(
            (weights,),
            {
                RESULT: word_of(done.verdict()),
                "rmse_mm": median,
                "rmse_p95_mm": float(rmse.nanquantile(0.95)),
                "seen": done.seen,
                "frames": len(solution.take),
                "fps": float(solution.take.fps),
                "solve_seconds": done.seconds,
            },
            f"{median:.2f} mm, {len(solution.take)} frames",
            done.warnings,
            picture,
        )

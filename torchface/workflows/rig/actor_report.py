"""What was made of an actor's scans, for people to read."""

from dataclasses import dataclass
from pathlib import Path

from torchface.modeling import ExampleRig, NormalMap
from torchface.modeling.rigging.part_clearance import Penetration
from torchface.registration import Registration
from torchface.rig import BlendshapeRig
from torchface.shape_names import ARKIT, recognised_shapes

_FEW = 8  # missing shapes of ARKit, up to which a template is one of them


@dataclass(frozen=True, eq=False)
class ActorReport:
    """What was made, and how near it comes to the scans."""

    rig: BlendshapeRig  # the actor's, in the template's place
    neutral: Registration  # the neutral scan's registration
    transfer_summary: str  # on triangles without area; empty where there are none
    examples: ExampleRig | None  # what the examples taught; None without any
    example_names: tuple[str, ...]  # the examples used, in the order of `examples.errors`
    maps: dict[str, NormalMap]  # the baked normal maps by name, the neutral's first
    skipped: tuple[str, ...]  # lines on scans that could not be used
    figure: Path  # of the registration: scan, face, distances and lines
    penetration: Penetration | None = None  # how far teeth, gums and eyes stand out of the skin
    predicted: int = 0  # how many of the shapes a model of expressions has predicted

    def verdict(self) -> str:
        """Whether the rig is to be used, in a line."""
        found = self.neutral.record.verdict()
        if not self.skipped:
            return found
        what = f"{len(self.skipped)} {'scans' if len(self.skipped) > 1 else 'scan'} skipped"
        return found.replace("result: good", "result: partly usable", 1) + f"; {what}"

    def lines(self) -> list[str]:
        """For people to read."""
        record = self.neutral.record
        lines = [f"neutral: aligned with the scan by {record.start}; {record.figures()}"]
        lines += [f"  {remark}" for remark in record.remarks]
        if not record.bent:
            lines = [f"neutral: {note}" for note in record.notes]
        lines.insert(0, self.verdict())
        lines.append(f"  figure: {self.figure}")
        lines.append(f"rig: {len(self.rig.vertices)} vertices, {len(self.rig.names)} shapes transferred")
        if self.predicted:
            lines[-1] += f", {self.predicted} of them predicted by the model of expressions"
        lacking = [name for name in ARKIT if name not in recognised_shapes(self.rig.names)]
        if len(lacking) <= _FEW and lacking:
            lines[-1] += f"; not of ARKit's 52: {', '.join(lacking)} (the template has no such shape)"
        lines += [f"  note: {self.transfer_summary}"] if self.transfer_summary else []
        lines += [] if self.penetration is None else [self.penetration.line()]
        if self.examples is not None:
            errors = self.examples.errors
            lines.append(
                f"examples: {len(self.example_names)}, from {float(errors[0].mean()):.2f} mm (transferred shapes) to "
                f"{float(errors[-1].mean()):.2f} mm root mean square; the shapes rotated by up to "
                f"{float(self.examples.angles.max()):.0f}°"
            )
            lines += [
                f"  {name}: {float(before):.2f} to {float(after):.2f} mm"
                for name, before, after in zip(self.example_names, errors[0], errors[-1], strict=True)
            ]
        if self.maps:
            lines.append(f"normal maps: {len(self.maps)}")
            lines += [
                f"  {name}: {baked.statistics.hit_share:.0%} of the texels found the scan, median "
                f"{baked.statistics.median_distance:.2f} mm apart"
                for name, baked in self.maps.items()
            ]
        return lines + [f"skipped: {line}" for line in self.skipped]

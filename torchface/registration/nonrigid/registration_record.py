"""Record of a registration."""

import math
from dataclasses import dataclass, field

# What is usual: heads of other people, noise of 1.5 mm and holes included, come to a 95th percentile of 0.8 mm and a
# stretch of 30 %; a head made half as high again stretches by 52 %, a box by 129 %. Landmarks that
# err at random by 1.5, 3 and 8 mm an axis end 1.9, 3.1 and 8.2 mm beside their vertices; that all are moved alike shows
# at the start alone (`scan_start`).
_FAR, _STRETCHED, _TORN, _SLID = 1.0, 0.45, 0.8, 4.0


@dataclass(frozen=True)
class StageRecord:
    """One stage."""

    stage: str  # its number and what was free to move, for example `"3 graph"`
    stiffness: float  # \\alpha
    iterations: int  # linear steps made
    moved: float  # mean motion of a vertex in the last of them, millimetres
    distance: float  # mean distance of the correspondences that were used, millimetres
    landmark_distance: float  # root mean square, millimetres; NaN without landmarks
    used: int  # correspondences that were used
    # correspondences refused, by reason: `distance`, `border`, `normal`, `fold` where a triangle would have turned
    # over, and `hidden` under hair, cloth or where an ear came out in pieces
    dropped: dict[str, int]
    energies: tuple[tuple[float, float], ...]  # cost before and after each linear step, its correspondences held
    seconds: float = field(compare=False)


@dataclass(frozen=True)
class RegistrationRecord:
    """A whole registration."""

    # how the template came to lie on the scan: "landmarks", "detected landmarks", "shape" or "its triangles"
    start: str
    start_distance: float  # median distance from template to scan after that, millimetres
    stages: tuple[StageRecord, ...]  # in order
    notes: tuple[str, ...]  # what was found in the input and what was done about it, for people to read
    median_distance: float  # of the exposed vertices that found the scan, to it, millimetres
    matched: float  # share of the template's vertices whose position the scan shows; the others follow their neighbours
    seconds: float = field(compare=False)
    far_distance: float = math.nan  # as the median, but the 95th percentile
    shown: float = math.nan  # share of what faces outward, whose position the scan shows
    # Share of what faces outward that lies under hair, cloth or on an ear in pieces: the template's.
    covered: float = 0.0
    # By which share of its length the 95th percentile of the edges that the scan shows has grown or shrunk beyond the
    # whole.
    stretch: float = math.nan
    # How far the landmarks inside the face end from their vertices, median, millimetres; NaN without any. What slides
    # along the surface is as near to it as what does not: no distance to the scan shows this.
    slid: float = math.nan
    bent: bool = True  # False of a head that has the template's triangles and was taken as it is

    def figures(self, of: str = "the scan") -> str:
        """How near it has come, how much of it the scan shows, and how far it has slid, in one line; ``of`` says what
        the scan is."""
        covered = f", {self.covered:.0%} lies under hair, cloth or a broken ear" if self.covered >= 0.005 else ""
        slid = f"{of}'s landmarks inside the face lie {self.slid:.1f} mm from the bent template's (median)"
        if math.isnan(self.slid):
            slid = "without landmarks no figure says whether the mesh lies too far to a side on the skin"
        return (
            f"median {self.median_distance:.3f} mm, 95th percentile {self.far_distance:.3f} mm from {of}, which "
            f"shows {self.shown:.0%} of the template's outer side{covered}; edges stretched by up to "
            f"{self.stretch:.0%}; {slid}"
        )

    def verdict(self) -> str:
        """Whether the result is to be used, in a line."""
        fit = (
            f"95 % of what the scan shows lie within {self.far_distance:.2f} mm of it (at most {_FAR:g} mm is usual), "
            f"edges are stretched by up to {self.stretch:.0%} (at most {_STRETCHED:.0%} is usual)"
        )
        if not self.bent:
            fit = self.notes[0]
        warned = sum(note.startswith("warning") for note in self.notes)
        if self.slid > _SLID:
            fit += f", but landmarks lie {self.slid:.1f} mm beside the mesh's own (at most {_SLID:g} mm is usual)"
        near = self.far_distance <= _FAR and self.stretch <= _STRETCHED  # figures of NaN are not near
        doubtful = warned or not near or self.slid > _SLID
        word = "poor" if self.stretch > _TORN else "partly usable" if doubtful else "good"
        more = f"; {warned} {'warnings' if warned > 1 else 'warning'} below" if warned else ""
        return f"result: {word}, {fit}{more}"

    @property
    def remarks(self) -> list[str]:
        """The notes, each with the word that says what it is."""
        return [note if note.startswith("warning: ") else f"note: {note}" for note in self.notes]

    def __str__(self) -> str:
        lines = [f"start by {self.start}: median {self.start_distance:.2f} mm from the scan"]
        lines += [_line(stage) for stage in self.stages]
        lines.append(f"{self.figures()}, {self.seconds:.1f} s")
        return "\n".join([*lines, *self.remarks])


def _line(stage: StageRecord) -> str:
    dropped = ", ".join(f"{count} {reason}" for reason, count in stage.dropped.items() if count) or "none"
    return (
        f"{stage.stage:>16}  stiffness {stage.stiffness:6.2f}  {stage.iterations} steps  {stage.distance:6.3f} mm  "
        f"landmarks {stage.landmark_distance:5.2f} mm  used {stage.used}, dropped {dropped}  {stage.seconds:.2f} s"
    )

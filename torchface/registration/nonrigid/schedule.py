"""Schedule of a registration, as data."""

from dataclasses import dataclass
from enum import Enum

from torchface.errors import ValueRangeError
from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number


class Level(Enum):
    """What is free to move in a stage; the cost function is the same.

    Example:
        >>> [level.value for level in Level]  # from coarse to fine
        ['graph', 'translations', 'vertices']
    """

    GRAPH = "graph"
    """An affine map a node of a coarse graph; the vertices blend their nodes' maps."""
    TRANSLATIONS = "translations"
    """A translation a vertex on top of the affine maps so far."""
    VERTICES = "vertices"
    """An affine map a vertex: Amberg's system whole, the slowest."""


@dataclass(frozen=True)
class Stage:
    """One value of the stiffness, held until the vertices come to rest.

    Args:
        level: what is free to move.
        stiffness: :math:`\\alpha`; against data of one per 10 mm² of surface.
        landmark_weight: :math:`\\beta`.
        reach: millimetres; a correspondence further away is dropped, and one at half of it counts a quarter.
        samples: how many vertices of the template look for a correspondence; all of them if absent.
        iterations: at most.
        tolerance: :math:`\\varepsilon`, millimetres; the stage ends when the vertices move less on average.
        contact_weight: :math:`\\gamma`, of vertices that touch in the template and between which the scan shows no gap.

    Example:
        >>> coarse = Stage(Level.GRAPH, stiffness=18.0, landmark_weight=1.0, reach=30.0)
        >>> fine = Stage(Level.GRAPH, stiffness=2.0, landmark_weight=0.1, reach=5.0)
        >>> [stage.stiffness for stage in Schedule((coarse, fine)).stages]
        [18.0, 2.0]
    """

    level: Level
    stiffness: float
    landmark_weight: float
    reach: float
    samples: int | None = None
    iterations: int = 3
    tolerance: float = 0.02
    contact_weight: float = 0.0

    def __post_init__(self) -> None:
        checked_number("stage: stiffness", self.stiffness, 0.0, LARGEST_WEIGHT, above=True)
        checked_number("stage: reach", self.reach, above=True)
        for name in ("landmark_weight", "contact_weight", "tolerance"):
            checked_number(f"stage: {name}", getattr(self, name), 0.0, LARGEST_WEIGHT)
        for name in ("iterations", "samples"):
            if getattr(self, name) is not None:
                checked_count(f"stage: {name}", getattr(self, name), 1)


@dataclass(frozen=True)
class Schedule:
    """A whole registration; with ``Level.VERTICES`` in every stage it is the paper's.

    Args:
        stages: in order; stiffness falls, the weight of the landmarks with it.
        nodes: of the coarse graph.
        gradient_length: :math:`g` of :math:`G`, millimetres: how much a change of the linear part from vertex to
            vertex costs beside a change of the translation.
        sliding: :math:`\\rho`, the weight of a correspondence along the surface beside 1 across it.
        largest_angle: between the normals of a correspondence, degrees.
        opening: millimetres within which nothing may stand before a vertex that looks for a correspondence; what lies
            behind lips, lids and in nostrils follows its neighbours.

    Example:
        >>> from torchface.registration import DEFAULT_SCHEDULE
        >>> quick = Schedule(DEFAULT_SCHEDULE.stages[:3])
        >>> quick.stages[0].stiffness > quick.stages[-1].stiffness
        True
    """

    stages: tuple[Stage, ...]
    nodes: int = 300
    gradient_length: float = 30.0
    sliding: float = 0.03
    largest_angle: float = 60.0
    opening: float = 10.0

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueRangeError("schedule: found no stages, expected at least one")
        checked_count("schedule: nodes", self.nodes, 1)
        checked_number("schedule: gradient_length", self.gradient_length, above=True)
        checked_number("schedule: sliding", self.sliding, 0.0, 1.0, above=True)
        checked_number("schedule: largest_angle", self.largest_angle, 0.0, 180.0, above=True)
        checked_number("schedule: opening", self.opening)


DEFAULT_SCHEDULE = Schedule(
    (
        Stage(Level.GRAPH, 18.0, 10.0, 30.0, samples=2000, iterations=4),
        Stage(Level.GRAPH, 5.0, 10.0, 20.0, samples=2000, iterations=3),
        Stage(Level.GRAPH, 1.2, 5.0, 12.0, samples=2000, iterations=2, contact_weight=2.0),
        Stage(Level.GRAPH, 0.3, 2.0, 8.0, samples=2000, iterations=2, contact_weight=2.0),
        Stage(Level.TRANSLATIONS, 0.3, 1.0, 5.0, iterations=2, contact_weight=2.0),
    )
)
"""For heads of any resolution."""

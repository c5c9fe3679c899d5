"""Settings of the webcam's solve: the weights of its terms, and how quickly it learns a person."""

from dataclasses import dataclass

from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number


@dataclass(frozen=True)
class WebcamSettings:
    """How a webcam's frames are solved.

    Args:
        noise: of landmarks in one frame, as a share of the distance of the eyes' outer corners.
        prior_strength: of the shape prior; 1 is Bayes' rule, were landmarks' errors independent of each other.
        sparsity: the L1 penalty, for a weight of 1.
        ridge: for a squared weight of 1.
        motion: how far a weight wanders in a second, standard deviation.
        contour_slide: how much an error along the contour counts beside one across it, 0 to 1.
        steps: of Gauss and Newton, a frame.
        coefficients: of a person's landmarks.
        alike: for how long landmarks' errors stay alike, seconds: frames nearer to each other count as one.
        learning: for how long a person is learned, seconds of good frames.
        memory: after how long what was learned counts for 1/e while learning goes on, seconds.
        rest_penalty: for how unlikely a lasting expression is held beside a person's own shape.
        openness_noise, gaze_noise: standard deviations, of openness as a share of the open eye's, of eyeLook's weights.

    Raises:
        ValueRangeError: an argument is not as above.

    Example:
        >>> from torchface.capture.anybody import WebcamSolver
        >>> from torchface.synthetic import performer
        >>> few = WebcamSolver(performer(texture=False), settings=WebcamSettings(coefficients=8))
        >>> len(few.start().person)  # what is learned of a person
        8
    """

    noise: float = 0.015
    prior_strength: float = 0.3
    sparsity: float = 0.5
    ridge: float = 1e-2
    motion: float = 1.0
    contour_slide: float = 0.3
    steps: int = 1
    coefficients: int = 64
    alike: float = 0.3
    learning: float = 10.0
    memory: float = 20.0
    rest_penalty: float = 6.0
    openness_noise: float = 0.1
    gaze_noise: float = 0.05

    def __post_init__(self) -> None:
        for name in ("prior_strength", "sparsity", "ridge", "rest_penalty"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT)
        for name in ("noise", "motion", "alike", "learning", "memory", "openness_noise", "gaze_noise"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT, above=True)
        checked_number("contour_slide", self.contour_slide, 0.0, 1.0)
        checked_count("steps", self.steps, 1)
        checked_count("coefficients", self.coefficients, 1)

"""Settings of the video solve, alike for files, cameras and exported graphs: weights of terms, ends of steps."""

from dataclasses import dataclass

from torchface.number_checks import LARGEST_WEIGHT, checked_count, checked_number

# Of the eyes' distance: what models of landmarks are measured to be off, any face's and the actor's own.
_FOUND, _REFINED = 0.025, 0.015
_LEAST_FOUND = 0.5
# By the error of videos of the embedded performer, of strengths 1, 0.1, 0.03 and noises 1, 3, 6, 12 times as large.
_ALIKE, _FOUND_DYNAMICS = 3.0, 0.03
# A step of 0.15 at 30 frames a second: less would hold back a jaw that opens in a fifth of a second.
_MOTION = 0.8
_FPS = 30.0
# Of 0, 0.3 and 1, by the error of six real takes with noise of 0.5 to 2.5 % of the eyes' distance.
_SPARSITY = 0.3
# With a prior the energy is flat along its valley, and a frame's last steps creep there. The next frame begins where
# they end, so a few do, and a graph that takes as many gives the same weights.
_FOUND_STEPS = 5


@dataclass(frozen=True)
class VideoSettings:
    r"""What the terms of ``VideoSolver``'s energy weigh, and when its steps end.

    Args:
        pixel_noise: :math:`\sigma_0`, the least standard deviation of an inner landmark's coordinate, pixels.
        relative_noise: of a landmark, as a share of the distance of the eyes' outer corners as a camera straight ahead
            would see them: models of landmarks are off by more pixels in a larger face. 0 leaves ``pixel_noise``.
        sparsity: :math:`\beta`, for a weight of 1.
        ridge: :math:`\varepsilon`, for a squared weight of 1.
        dynamics_strength: by what the dynamics prior's variance is divided.
        pose_trust: :math:`\kappa`, what the tracked pose is worth beside the frame's own landmarks.
        contour_slide: how much an error along the contour counts beside one across it, 0 to 1. At 1 contour landmarks
            are the vertices themselves.
        motion: how far a weight wanders in a second, standard deviation; lids go further. Without a dynamics prior each
            frame's weights, and the head with them, are then a step of that random walk from the last frame's. 0 solves
            frames apart.
        interval: seconds from frame to frame where none are given.
        tolerance: a frame's steps end when no weight moves further than this.
        steps: of Gauss and Newton that a frame takes at most.

    Raises:
        ValueRangeError: an argument is not as above.

    Example:
        >>> VideoSettings().motion, VideoSettings.of_found_landmarks(fps=30.0).relative_noise > 0
        (0.0, True)
    """

    pixel_noise: float = 1.0
    relative_noise: float = 0.0
    sparsity: float = 1.0
    ridge: float = 1e-2
    dynamics_strength: float = 1.0
    pose_trust: float = 0.0
    contour_slide: float = 0.3
    motion: float = 0.0
    interval: float = 1 / 30
    tolerance: float = 3e-3
    steps: int = 30

    def __post_init__(self) -> None:
        for name in ("relative_noise", "sparsity", "ridge", "pose_trust", "motion"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT)
        for name in ("pixel_noise", "dynamics_strength", "tolerance", "interval"):
            checked_number(name, getattr(self, name), 0.0, LARGEST_WEIGHT, above=True)
        checked_number("contour_slide", self.contour_slide, 0.0, 1.0)
        checked_count("steps", self.steps, 1)

    @classmethod
    def of_found_landmarks(
        cls, remembers: bool = False, refined: bool = False, fps: float | None = None
    ) -> "VideoSettings":
        """For landmarks that a model has found in images, as ``torchface track`` solves them.

        Models of landmarks err alike in frames that look alike. A dynamics prior takes each frame's errors for new
        ones: it would soon be sure of what they have in common, so with one the noise is reckoned larger and the prior
        weaker.

        Args:
            remembers: the solver has a dynamics prior.
            refined: the landmarks come from a model of the actor's own looks.
            fps: frames a second of the video; 30 if absent.
        """
        share = _REFINED if refined else _FOUND
        interval = 1 / (fps or _FPS)
        if not remembers:
            return cls(
                pixel_noise=_LEAST_FOUND,
                relative_noise=share,
                sparsity=_SPARSITY,
                motion=_MOTION,
                interval=interval,
                steps=_FOUND_STEPS,
            )
        return cls(
            pixel_noise=_ALIKE * _LEAST_FOUND,
            relative_noise=_ALIKE * share,
            dynamics_strength=_FOUND_DYNAMICS,
            interval=interval,
            steps=_FOUND_STEPS,
        )

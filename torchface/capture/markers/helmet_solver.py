"""Blendshape weights from markers of a head-mounted stage whose helmet slips on the head."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from torchface.attachment import Attachment
from torchface.capture.corrective_energy import CorrectiveEnergy, least_in_box
from torchface.capture.energy import Quadratic, chunks_of_frames, marker_term
from torchface.capture.markers.given_markers import frames_seen, markers_of
from torchface.capture.markers.helmet_motion import HelmetMotion, rigid_columns, rigid_rotation, rough_motion
from torchface.capture.markers.marker_solver import RIDGE, SPARSITY, MarkerSolver
from torchface.errors import ShapeError
from torchface.geometry.similarity import Similarity
from torchface.number_checks import as_real
from torchface.optim import BoxQP, box_qp
from torchface.optim.box_checks import default_tolerance
from torchface.optim.data_dependent import data_dependent
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.temporal import interpolated, nearest_rows

# mm² a marker for a squared millimetre of slip: counts only where markers are too few to determine a motion.
_MOTION_RIDGE = 1e-4
_MAX_ITERATIONS, _MOTION_TOLERANCE = 6, 1e-4


class HelmetSolver(nn.Module):
    r"""Solves markers for blendshape weights and the helmet's motion, every frame on its own.

    .. math::
        \min_{0 \le w \le 1,\,R,\,t} \frac{1}{|S|} \sum_{m \in S}
        \lVert R (b_m + B_m w - c) + c + t - y_m \rVert^2 + \beta \sum_i w_i + \varepsilon \lVert w \rVert^2

    Six dummy shapes model the motion: translations along the axes and, as the small rotation :math:`d\omega \times
    (b_m - c)`, rotations about them. They are unbounded, in place of a positive and a negative one each, and
    without sparsity. ``exact`` undoes the rigid motion that a solve found and solves again until none is left, so that
    large motions are rigid too; otherwise there is one solve with the linear shapes.

    Args:
        rig, attachment, alignment, sparsity, ridge: as in ``MarkerSolver``.
        exact: a rigid motion; otherwise the linear dummy shapes.

    Raises:
        TopologyError, ShapeError, ValueRangeError: as in ``MarkerSolver``.

    Source: thesis 4.1.6, equations 34 to 37, with the derivative of the rotation in place of the 90-degree shapes,
        which also stretch the face.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks)
        >>> seen = sites.on(rig.neutral.faces, rig.vertices) + torch.tensor([0.0, 4.0, 0.0])
        >>> weights, motion = HelmetSolver(rig, sites)(seen[None])
        >>> bool(weights.max() < 0.1), round(motion.translation[0, 1].item())
        (True, 4)
    """

    def __init__(
        self,
        rig: BlendshapeRig,
        attachment: Attachment,
        alignment: Similarity | None = None,
        sparsity: float = SPARSITY,
        ridge: float = RIDGE,
        exact: bool = True,
    ) -> None:
        super().__init__()
        self.markers = MarkerSolver(rig, attachment, alignment, sparsity, ridge)
        self.exact = exact

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self.markers.names

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the markers."""
        return self.markers.labels

    @data_dependent("torchface.onnx.SolverGraph, for weights alone, which `torchface export solver` writes")
    def forward(self, markers: Tensor) -> tuple[Tensor, HelmetMotion]:
        """Weights and motion for markers.

        Args:
            markers: (B,M,3), millimetres, in the order of ``labels``; a marker with a NaN coordinate is not seen.

        Returns:
            Weights in [0,1], (B,N), in the dtype of ``markers``, and ``HelmetMotion`` of B frames, in rig space.

        Raises:
            ShapeError: ``markers`` is not (B,M,3).
            ValueRangeError: a coordinate is infinite, or frames show no marker at all.
        """
        markers = as_real(markers, "markers")
        if markers.ndim != 3 or markers.shape[1:] != self.markers.rest.shape:
            raise ShapeError(f"markers: found {tuple(markers.shape)}, expected (B,{len(self.markers.rest)},3)")
        seen = self.markers.in_rig_space(markers.double())
        tolerance = default_tolerance(markers.dtype)
        gaps = torch.isnan(seen).any(-1).any(-1)
        if bool(torch.isnan(seen).any(-1).all(-1).any()):
            self.markers(markers)  # its error names the empty frames
        weights = seen.new_zeros(len(seen), len(self.names))
        rotation = torch.eye(3, dtype=seen.dtype, device=seen.device).repeat(len(seen), 1, 1)
        translation = seen.new_zeros(len(seen), 3)
        # Frames without gaps share one H; each of the others has its own, a chunk of them in memory at once.
        for rows in [(~gaps).nonzero()[:, 0], *chunks_of_frames(gaps.nonzero()[:, 0], len(self.names) + 6)]:
            if len(rows):
                weights[rows], rotation[rows], translation[rows] = self._solve(seen[rows], tolerance)
        motion = HelmetMotion(rotation, translation, self.markers.rest.double().mean(0))
        return weights.to(markers.dtype), motion

    def solve_take(self, take: Take) -> tuple[Take, HelmetMotion]:
        """The take with weights solved from its markers, matched by label; and the motion that is not in them.

        A frame without any marker gets weights between those of the frames before and after, and the nearest's motion.

        Raises:
            NameMismatchError: the take has no markers, labels that the attachment does not know, or none that it knows.
            ValueRangeError: no frame shows any marker.
        """
        markers = self.markers.arrange(markers_of(take))
        rows = frames_seen(markers)
        seen, steps = self(markers[rows])
        weights = interpolated(seen, rows, len(markers))
        nearest = nearest_rows(rows, len(markers))
        motion = HelmetMotion(steps.rotation[nearest], steps.translation[nearest], steps.pivot)
        return replace(take, weights=Track(self.names, weights[..., None])), motion

    def _solve(self, seen: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
        """Weights (B,N), rotation (B,3,3), translation (B,3) for markers in rig space."""
        rest = self.markers.rest.double()
        pivot = rest.mean(0)
        columns = torch.cat([self.markers.basis.double(), rigid_columns(rest, pivot)], dim=2)
        corrective, activation = self.markers.corrective_basis, self.markers.activation
        shapes = len(self.names)
        bound = rest.new_tensor([torch.inf]).expand(6)
        lower = torch.cat([rest.new_zeros(shapes), -bound])
        upper = torch.cat([rest.new_ones(shapes), bound])
        penalty = rest.new_zeros(shapes + 6)
        penalty[:shapes] = self.markers.sparsity
        ridge = rest.new_full((shapes + 6,), 2 * _MOTION_RIDGE)
        ridge[:shapes] = 2 * self.markers.ridge
        start = rough_motion(seen.detach(), rest)[0] if self.exact else HelmetMotion.none(seen, pivot)
        rotation, translation = start.rotation, start.translation
        solution: Tensor | None = None
        shared: BoxQP | None = None
        # Correctives join after a first solve without them.
        for _ in range((_MAX_ITERATIONS if self.exact else 1) + (activation is not None)):
            unmoved = HelmetMotion(rotation, translation, pivot).undo(seen)
            energy = marker_term(columns, rest, unmoved)
            H, f = energy.H + torch.diag(ridge), energy.f + penalty
            if activation is not None and corrective is not None and solution is not None:
                extended = marker_term(torch.cat([columns, corrective.double()], 2), rest, unmoved)
                whole = CorrectiveEnergy(extended, activation) + Quadratic(torch.diag(ridge), penalty[None])
                solution = least_in_box(whole, solution, lower, upper, tolerance)
            elif H.ndim == 2:
                shared = shared or BoxQP(H, lower, upper, tolerance)
                solution = shared(f, solution)
            else:
                solution = box_qp(H, f, lower, upper, solution, tolerance)
            step = solution[:, shapes : shapes + 3]
            translation = translation + (rotation @ step[..., None])[..., 0]
            rotation = rotation @ rigid_rotation(solution[:, shapes + 3 :])
            moved = float(solution[:, shapes:].detach().abs().max())
            solution = torch.cat([solution[:, :shapes], torch.zeros_like(solution[:, shapes:])], dim=1)
            if moved < _MOTION_TOLERANCE:
                break
        assert solution is not None
        return solution[:, :shapes], rotation, translation

    def extra_repr(self) -> str:
        return f"exact={self.exact}"

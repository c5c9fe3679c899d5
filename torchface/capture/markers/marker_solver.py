"""Blendshape weights from 3D markers."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torchface.attachment import Attachment
from torchface.capture.antagonist_shapes import one_side, signed_quantities, weaker_sides
from torchface.capture.corrective_energy import CorrectiveEnergy, least_in_box
from torchface.capture.energy import (
    Quadratic,
    check_markers,
    check_weight,
    chunks_of_frames,
    marker_term,
    ridge_term,
    sparsity_term,
)
from torchface.capture.markers.given_markers import check_labels, check_seen, frames_seen, markers_of
from torchface.correctives.activation import CorrectiveActivation
from torchface.correctives.corrective_shapes import Corrective, definitions_from_records
from torchface.errors import NameMismatchError, ShapeError, ValueRangeError
from torchface.geometry.similarity import Similarity
from torchface.number_checks import as_tensor, checked_type
from torchface.optim import BoxQP, ProjectedGradient, box_qp
from torchface.optim.box_checks import default_tolerance
from torchface.optim.data_dependent import data_dependent
from torchface.optim.prepared_tensors import Prepared
from torchface.rig import BlendshapeRig
from torchface.take import Take, Track
from torchface.temporal import interpolated

# The paper's rule (β‖w‖₁ as large as the squared error, thesis 4.1.4) gives 0.03 to 0.07 on real takes, where weights
# come out a fifth too small; at 0.01 as many shapes are active as in truth.
SPARSITY = 0.01
# Small against the smallest curvature that 100 markers give 53 real shapes, yet enough for layouts that see less.
RIDGE = 1e-3


class MarkerSolver(nn.Module):
    r"""Solves markers for blendshape weights, every frame on its own.

    .. math::
        \min_{0 \le w \le 1} \frac{1}{|S|} \sum_{m \in S} \lVert b_m + B_m w - t_m \rVert^2
        + \beta \sum_i w_i + \varepsilon \lVert w \rVert^2

    A rig with correctives adds :math:`C_m a(w)` to the distance, with their activations a (``torchface.correctives``);
    the solve without them is where Gauss-Newton starts from, see ``torchface.capture.corrective_energy``.

    The first term is the mean over the markers S that a frame shows, in mm² a marker, so that ``sparsity`` and
    ``ridge`` mean the same for any number of markers. H and f are formed in float64.

    Args:
        rig: N shapes; its correctives count.
        attachment: where the M markers sit on it; its ``residual``, where it has one, is added to the points.
        alignment: moves marker space into rig space, one similarity; none if absent. Errors count in rig space.
        sparsity: :math:`\beta`, mm² a marker for a weight of 1. A tensor of one number is kept as a parameter
            (``nn.Parameter``) or a buffer, and the weights are differentiable in it.
        ridge: :math:`\varepsilon`, mm² a marker for a squared weight of 1; as ``sparsity``.
        program: solves the quadratic programs in place of ``box_qp``: without an H of its own, bounds 0 and 1. With
            correctives it solves what their Gauss-Newton starts from.
        antagonists: of two shapes that undo each other, such as jawLeft and jawRight, one is 0: the smaller one of a
            frame where both come out above 0, which is then solved again.

    Raises:
        TopologyError: the attachment belongs to another mesh.
        ValueRangeError: ``sparsity`` or ``ridge`` is negative or not finite, or ``program`` has an H or other bounds.
        ShapeError: ``alignment`` holds more than one similarity, or ``sparsity`` or ``ridge`` more than one number.

    Source: thesis 4.1.3, 4.1.4 and appendix.

    Example:
        >>> from torchface.synthetic import performer
        >>> rig = performer(texture=False)
        >>> sites = Attachment.from_vertices(rig.neutral, rig.neutral.landmarks)
        >>> solver = MarkerSolver(rig, sites, sparsity=0.0)
        >>> weights = rig.vertices.new_zeros(1, len(rig.names))
        >>> weights[0, rig.index(["jawOpen"])] = 0.5
        >>> found = solver(sites.on(rig.neutral.faces, rig(weights)))
        >>> bool((found - weights).abs().max() < 0.05)
        True
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    basis: Tensor
    rest: Tensor
    corrective_basis: Tensor | None
    program: ProjectedGradient | None

    def __init__(
        self,
        rig: BlendshapeRig,
        attachment: Attachment,
        alignment: Similarity | None = None,
        sparsity: float | Tensor = SPARSITY,
        ridge: float | Tensor = RIDGE,
        program: ProjectedGradient | None = None,
        antagonists: bool = False,
    ) -> None:
        super().__init__()
        checked_type("rig", rig, BlendshapeRig)
        checked_type("attachment", attachment, Attachment).check(rig.neutral)
        if program is not None:
            checked_type("program", program, ProjectedGradient)
        if program is not None and (program.H is not None or bool(((program.lower != 0) | (program.upper != 1)).any())):
            raise ValueRangeError(f"program: found {program}, expected none of H or bounds, as of ProjectedGradient()")
        faces, residual = rig.neutral.faces, attachment.residual
        rest = attachment.on(faces, rig.vertices)
        rest = rest if residual is None else rest + residual.to(rest)
        basis = attachment.on(faces, rig.deltas).permute(1, 2, 0).contiguous()
        self.names, self.labels = rig.names, tuple(attachment.labels or ())
        self._register(basis, rest, alignment, sparsity, ridge)
        if rig.correctives is not None:
            moved = attachment.on(faces, rig.correctives.deltas).permute(1, 2, 0).contiguous()
            self._correct(rig.correctives.definitions, moved)
        self.program, self.antagonists = program, checked_type("antagonists", antagonists, bool)

    def _register(
        self, basis: Tensor, rest: Tensor, alignment: Similarity | None, sparsity: float | Tensor, ridge: float | Tensor
    ) -> None:
        self.sparsity, self.ridge = self._penalty("sparsity", sparsity), self._penalty("ridge", ridge)
        self.register_buffer("basis", basis)
        self.register_buffer("rest", rest)
        if alignment is not None and alignment.scale.shape != (1,):
            raise ShapeError(f"alignment: found {tuple(alignment.scale.shape)} similarities, expected (1,)")
        for name in ("scale", "rotation", "translation"):
            self.register_buffer(f"alignment_{name}", None if alignment is None else getattr(alignment, name).to(rest))
        self.activation: CorrectiveActivation | None = None
        self.register_buffer("corrective_basis", None)
        self._prepared: dict[float, Prepared[BoxQP]] = {}
        self._prepared_rows: Prepared[tuple[Tensor, Tensor]] = Prepared()

    def _correct(self, definitions: Sequence[Corrective], basis: Tensor) -> None:
        """Takes up correctives and what a unit of each adds to the markers, (M,3,C)."""
        activation = CorrectiveActivation(definitions, self.names)
        self.activation = activation if basis.is_meta else activation.to(basis.device)
        self.corrective_basis = basis

    def _penalty(self, name: str, value: float | Tensor) -> float | Tensor:
        """A number as it is; a tensor of one as a scalar that moves and saves with the module."""
        if isinstance(value, Tensor) and value.numel() != 1:
            raise ShapeError(f"{name}: found {tuple(value.shape)}, expected one number")
        check_weight(name, value)  # a negative weight is an error here, not at the first solve
        if not isinstance(value, Tensor):
            return float(value)
        if not isinstance(value, nn.Parameter):
            self.register_buffer(name, value)
        return value

    @property
    def config(self) -> dict[str, Any]:
        """What :meth:`from_config` needs beside the state: plain values only."""
        return {
            "names": list(self.names),
            "labels": list(self.labels),
            "sparsity": penalty_value(self.sparsity),
            "ridge": penalty_value(self.ridge),
            "aligned": self.alignment is not None,
            **({} if self.activation is None else {"correctives": self.activation.records()}),
            **({} if self.program is None else {"program": self.program.config}),
            **({"antagonists": True} if self.antagonists else {}),
            # In the state, with their shapes.
            "tensors": {
                name: list(value.shape)
                for name in ("sparsity", "ridge")
                if isinstance(value := getattr(self, name), Tensor)
            },
        }

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "MarkerSolver":
        """A solver of zeros for the state to be loaded into, without the rig it came from.

        Raises:
            NameMismatchError: a name or a label is no text, or there twice, or a corrective is none.
            ValueRangeError: ``sparsity`` or ``ridge`` is negative or not finite.
        """
        names, labels = config["names"], config["labels"]
        for what, found in (("names", names), ("labels", labels)):
            texts = isinstance(found, list) and all(isinstance(name, str) for name in found)
            if not texts or len(set(found)) < len(found):
                raise NameMismatchError(f"{what}: found {found!r:.80}, expected a list of distinct names")
        self = cls.__new__(cls)
        nn.Module.__init__(self)
        alignment = Similarity(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3)) if config["aligned"] else None
        basis, rest = torch.zeros(len(labels), 3, len(names)), torch.zeros(len(labels), 3)
        sparsity, ridge = (
            torch.zeros(config["tensors"][name]) if name in config.get("tensors", {}) else config[name]
            for name in ("sparsity", "ridge")
        )
        self.names, self.labels = tuple(names), tuple(labels)
        self._register(basis, rest, alignment, sparsity, ridge)
        if definitions := definitions_from_records(config.get("correctives", [])):
            self._correct(definitions, torch.zeros(len(labels), 3, len(definitions)))
        self.program = ProjectedGradient(**config["program"]) if "program" in config else None
        self.antagonists = config.get("antagonists", False) is True
        return self

    @property
    def alignment(self) -> Similarity | None:
        """Marker space to rig space."""
        parts = [getattr(self, f"alignment_{name}") for name in ("scale", "rotation", "translation")]
        return None if parts[0] is None else Similarity(*parts)

    def regularization(self, like: Tensor) -> Quadratic:
        """The sparsity and the ridge term, in the dtype and on the device of ``like``."""
        return sparsity_term(len(self.names), self.sparsity, like) + ridge_term(len(self.names), self.ridge, like)

    def energy(self, markers: Tensor) -> Quadratic | CorrectiveEnergy:
        """What the solve minimises for markers (B,M,3), float64."""
        rest = self.rest.double()
        term = marker_term(self.every_basis.double(), rest, self.in_rig_space(markers.double()))
        energy = term if self.activation is None else CorrectiveEnergy(term, self.activation)
        return energy + self.regularization(rest)

    def points(self, weights: Tensor) -> Tensor:
        """Where the markers' sites are at weights (B,N): (B,M,3) in rig space, float64."""
        values = weights.double()
        if self.activation is not None:
            values = torch.cat([values, self.activation(values)], 1)
        return self.rest.double() + torch.einsum("mcn,bn->bmc", self.every_basis.double(), values)

    @property
    def every_basis(self) -> Tensor:
        """What a unit of each shape, and of each corrective, adds to the markers, (M,3,N+C)."""
        return self.basis if self.corrective_basis is None else torch.cat([self.basis, self.corrective_basis], 2)

    def squared_distance(self, markers: Tensor, weights: Tensor) -> Tensor:
        """Mean squared distance of the seen markers (B,M,3) to the rig at weights (B,N): (B,), mm² in rig space."""
        return (self.points(weights) - self.in_rig_space(markers.double())).square().sum(-1).nanmean(-1)

    @data_dependent("torchface.onnx.SolverGraph, which `torchface export solver` writes")
    def forward(self, markers: Tensor, initial: Tensor | None = None) -> Tensor:
        """Weights for markers.

        Args:
            markers: (B,M,3), millimetres, in the order of ``labels``; a marker with a NaN coordinate is not seen.
            initial: initial guess of the weights, (B,N).

        Returns:
            Weights in [0,1], (B,N), in the dtype of ``markers``; differentiable in ``markers``.

        Raises:
            ShapeError: ``markers`` is not (B,M,3).
            ValueRangeError: a coordinate is infinite, or frames show no marker at all.
        """
        markers = as_tensor("markers", markers, f"(B,{len(self.rest)},3)")
        if markers.ndim != 3 or markers.shape[1:] != self.rest.shape:
            raise ShapeError(f"markers: found {tuple(markers.shape)}, expected (B,{len(self.rest)},3)")
        check_markers(markers)
        missing = torch.isnan(markers).any(-1)
        check_seen(missing)
        tolerance = default_tolerance(markers.dtype)
        weights = self._solved(markers, missing.any(-1), None if initial is None else initial.double(), tolerance)
        return (self._one_sided(markers, weights, tolerance) if self.antagonists else weights).to(markers.dtype)

    def _solved(self, markers: Tensor, gaps: Tensor, initial: Tensor | None, tolerance: float) -> Tensor:
        """Weights (B,N), float64; with correctives by Gauss-Newton, from the answer without where nothing is given."""
        far = self.activation is not None and initial is None
        if far:
            with torch.no_grad():
                initial = self.without_correctives()(markers.detach()).double()
        if not bool(gaps.any()):
            return self._chunk(markers, True, initial, far, tolerance)
        # A frame with gaps has an H of its own; a chunk of them bounds the memory.
        whole = (~gaps).nonzero()[:, 0]
        others = chunks_of_frames(gaps.nonzero()[:, 0], self.every_basis.shape[2])
        chunks, parts = [whole, *others] if len(whole) else [*others], []
        for rows in chunks:
            guess = None if initial is None else initial[rows]
            parts.append(self._chunk(markers[rows], rows is whole, guess, far, tolerance))
        weights = markers.new_zeros(len(markers), len(self.names), dtype=torch.float64)
        return weights.index_copy(0, torch.cat(chunks), torch.cat(parts))

    def _chunk(self, markers: Tensor, complete: bool, guess: Tensor | None, far: bool, tolerance: float) -> Tensor:
        """Weights (B,N), float64, of markers all or none of which have gaps."""
        if complete and self.activation is None:
            f = self.complete_slope(markers)
            if self.program is not None:
                return self.program(f, self.complete_hessian(), guess)
            return self._shared(tolerance)(f, guess)
        energy = self.complete_energy(markers) if complete else self.energy(markers)
        if isinstance(energy, CorrectiveEnergy):
            assert guess is not None
            lower = guess.new_zeros(len(self.names))
            return least_in_box(energy, guess, lower, torch.ones_like(lower), tolerance, far)
        if self.program is not None:
            return self.program(energy.f, energy.H, guess)
        return box_qp(energy.H, energy.f, 0.0, 1.0, guess, tolerance)

    def _one_sided(self, markers: Tensor, weights: Tensor, tolerance: float) -> Tensor:
        """Weights (B,N), float64, solved again with the weaker of two antagonists at 0 where both are above."""
        signed = signed_quantities(self.names).to(weights)
        weaker = weaker_sides(weights.detach(), signed)
        both = (weaker & (weights > 0)).any(1)
        for held in weaker[both].unique(dim=0):  # frames with the same sides at rest share a box
            for rows in chunks_of_frames((both & (weaker == held).all(1)).nonzero()[:, 0], len(self.names)):
                upper, start, energy = (~held).to(weights), weights[rows].detach() * ~held, self.energy(markers[rows])
                part = least_in_box(energy, start, torch.zeros_like(upper), upper, tolerance, False)
                weights = weights.index_copy(0, rows, part)
        return one_side(weights, signed)

    def solve_take(self, take: Take) -> Take:
        """The take with weights solved from its markers, matched by label.

        A marker of the attachment that the take lacks counts as never seen. A frame without any marker gets weights
        between those of the frames before and after.

        Raises:
            NameMismatchError: the take has no markers, labels that the attachment does not know, or none that it knows.
            ValueRangeError: no frame shows any marker.

        Example:
            >>> from torchface import Track, zoo
            >>> solver = zoo.get_model("marker_solver")
            >>> still = solver.points(torch.zeros(5, len(solver.names)))
            >>> solved = solver.solve_take(Take(60.0, markers=Track(solver.labels, still.float())))
            >>> solved.weights.names == solver.names, bool(solved.weights.values.max() < 1e-3)
            (True, True)
        """
        markers = self.arrange(markers_of(take))
        rows = frames_seen(markers)
        weights = interpolated(self(markers[rows]), rows, len(markers))
        return replace(take, weights=Track(self.names, weights[..., None]))

    def arrange(self, markers: Track) -> Tensor:
        """Marker positions (T,M,3) in the order of ``labels``; NaN for a marker that the track lacks."""
        check_labels(markers.names, self.labels)
        row = {label: i for i, label in enumerate(self.labels)}
        ids = torch.tensor([row[name] for name in markers.names], device=markers.values.device)
        arranged = markers.values.new_full((len(markers), len(self.labels), 3), torch.nan)
        return arranged.index_copy(1, ids, markers.values).to(self.rest.device)

    def complete_slope(self, markers: Tensor) -> Tensor:
        """The energy's slope at rest, (B,N), float64, for markers without gaps."""
        offset = self.rest.double() - self.in_rig_space(markers.double())
        return (2.0 / len(self.rest)) * (offset.flatten(1) @ self.basis.double().flatten(0, 1)) + self.sparsity

    @property
    def _learns(self) -> bool:
        """Whether gradients are asked for in what is prepared once."""
        parts = (self.basis, self.corrective_basis, self.rest, self.ridge)
        return torch.is_grad_enabled() and any(isinstance(part, Tensor) and part.requires_grad for part in parts)

    def complete_energy(self, markers: Tensor) -> CorrectiveEnergy | Quadratic:
        """``energy`` of markers without gaps, its H formed on first use."""
        if self._learns:
            return self.energy(markers)
        made_of = (self.basis,) if self.corrective_basis is None else (self.basis, self.corrective_basis)
        H, rows = self._prepared_rows.get(made_of, self._extended_rows)
        offset = (self.rest.double() - self.in_rig_space(markers.double())).flatten(1)
        share = 2.0 / len(self.rest)
        term = Quadratic(H, share * (offset @ rows), 0.5 * share * offset.square().sum(1))
        return (term if self.activation is None else CorrectiveEnergy(term, self.activation)) + self.regularization(H)

    def _extended_rows(self) -> tuple[Tensor, Tensor]:
        """Of shapes and correctives: H (N+C,N+C) of complete frames, and what each does to the markers (3M,N+C)."""
        rows = self.every_basis.double().flatten(0, 1)
        return (2.0 / len(self.rest)) * (rows.T @ rows), rows

    def without_correctives(self) -> "MarkerSolver":
        """The same solver of the rig's shapes alone; the solver itself where there are no correctives."""
        if self.activation is None:
            return self
        linear = copy.copy(self)
        linear._buffers = {**self._buffers, "corrective_basis": None}
        linear._modules = {} if self.program is None else {"program": self.program}
        linear.activation = None
        return linear

    def _shared(self, tolerance: float) -> BoxQP:
        """The problem of complete frames: prepared once, and anew where what it is made of has changed."""
        if self._learns:
            return BoxQP(self.complete_hessian(), 0.0, 1.0, tolerance)  # a graph serves one backward pass
        prepare = self._prepared.setdefault(tolerance, Prepared())
        return prepare.get((self.basis, self.ridge), lambda: BoxQP(self.complete_hessian(), 0.0, 1.0, tolerance))

    def complete_hessian(self) -> Tensor:
        """The energy's H, (N,N), float64, for markers without gaps."""
        rest = self.rest.double()
        return (marker_term(self.basis.double(), rest, rest[None]) + self.regularization(rest)).H

    def in_rig_space(self, markers: Tensor) -> Tensor:
        """Markers (B,M,3) moved by the alignment, where there is one."""
        alignment = self.alignment
        return markers if alignment is None else alignment.apply(markers)

    def extra_repr(self) -> str:
        sparsity, ridge = penalty_value(self.sparsity), penalty_value(self.ridge)
        return f"{len(self.labels)} markers, {len(self.names)} shapes, sparsity={sparsity:g}, ridge={ridge:g}"


def penalty_value(penalty: float | Tensor) -> float:
    """The value of a solver's ``sparsity`` or ``ridge``, without its gradient."""
    return penalty.item() if isinstance(penalty, Tensor) else penalty

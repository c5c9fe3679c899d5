"""A personal rig from a template and a few example expressions of the person."""

import copy
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torchface.errors import ShapeError, TopologyError, ValueRangeError
from torchface.geometry.meshes.deformation import deformation_gradients, gradient_operator
from torchface.mesh import Mesh
from torchface.modeling.rigging.deformation_transfer import CONTACT_WEIGHT, TransferReport, transfer_report
from torchface.modeling.rigging.example_gradients import example_shares, personal_part, shape_stiffness
from torchface.modeling.rigging.transfer_system import ShapeTransfer
from torchface.number_checks import LARGEST_WEIGHT, as_real, checked_count, checked_number, checked_type
from torchface.optim import box_qp
from torchface.progress import Progress, silent
from torchface.rig import BlendshapeRig

_EXACT = 0.01  # millimetres a vertex; a rig that misses examples by less does not show how good weights are


@dataclass(frozen=True)
class RiggingSchedule:
    r"""How the examples' influence grows from iteration to iteration.

    Args:
        iterations: how often shapes and weights are solved alternately.
        beta: weight of the prior beside the fit, first and last iteration; linear in between. What is left at the
            end is for examples as good as the person's own shapes; scans are noisier.
        gamma: weight of the pull to the given weights, first and last iteration; linear in between. Its unit is what
            the transferred shapes leave of an example at the weights that suit them best (squared distances summed
            over the vertices, the mean of the examples): with 100, a weight that leaves the given one by 0.1 costs as
            much as all of that. Much lower, and the weights take in what is the person's own; weights that are mere
            guesses want 10 to 25.
        unnamed: how many times more firmly a weight is held that was given as 0: what was not asked for.
        kappa: where the prior's stiffness saturates, in gradients without unit.
        theta: how steeply the stiffness falls where the template deforms.

    Raises:
        ValueRangeError: no iteration, or a number that is not positive.

    Source: Li, Weise and Pauly 2010.

    Example:
        >>> schedule = RiggingSchedule(iterations=3, beta=(0.5, 0.1), gamma=(100.0, 10.0))
        >>> [round(schedule.at(number)[0], 2) for number in range(3)]
        [0.5, 0.3, 0.1]
    """

    iterations: int = 10
    beta: tuple[float, float] = (0.5, 0.03)
    gamma: tuple[float, float] = (100.0, 100.0)
    unnamed: float = 20.0
    kappa: float = 0.1
    theta: float = 2.0

    def __post_init__(self) -> None:
        checked_count("iterations", self.iterations, 1)
        for name in ("beta", "gamma"):
            if not isinstance(getattr(self, name), tuple | list) or len(getattr(self, name)) != 2:
                raise ShapeError(f"{name}: found {getattr(self, name)}, expected two numbers, first and last iteration")
        for name, numbers in (
            ("beta", self.beta),
            ("gamma", self.gamma),
            ("unnamed", (self.unnamed,)),
            ("kappa", (self.kappa,)),
            ("theta", (self.theta,)),
        ):
            for number in numbers:
                checked_number(name, number, 0.0, LARGEST_WEIGHT, above=True)

    def at(self, number: int) -> tuple[float, float]:
        """Beta and gamma of an iteration, counted from 0."""
        share = number / max(self.iterations - 1, 1)
        return tuple(first + share * (last - first) for first, last in (self.beta, self.gamma))  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class ExampleRig:
    """A personal rig and how it came about.

    Args:
        rig: the person's neutral and shapes, with the template's names.
        weights: what each example is in the rig, (M,N).
        transferred: the initial shapes: the template's by deformation transfer.
        errors: root mean square distance of every example's vertices from the rig's, millimetres, (iterations+1,M); the
            first row is the transferred rig at the given weights.
        angles: how far each shape's direction went from the transferred one's, degrees, (N,).
        report: what the transfer found on its way.
    """

    rig: BlendshapeRig
    weights: Tensor
    transferred: BlendshapeRig
    errors: Tensor
    angles: Tensor
    report: TransferReport


def rig_from_examples(
    template: BlendshapeRig,
    neutral: Mesh,
    examples: Tensor,
    weights: Tensor,
    schedule: RiggingSchedule | None = None,
    contact_weight: float = CONTACT_WEIGHT,
    progress: Progress | None = None,
) -> ExampleRig:
    r"""Learns a person's own shapes from a few expressions, keeping what the template's names mean.

    .. math:: \min_{M} \sum_j \Big\lVert M^S_j - M_0 - \sum_i \alpha_{ji} M_i \Big\rVert_F^2
        + \beta \sum_i w_i \lVert M_i - M_i^* \rVert_F^2

    for the gradients M of the shapes' triangles, with :math:`M^*` what deformation transfer gives and w high where the
    template hardly deforms; then, for the weights of each example, all in [0,1],

    .. math:: \min_\alpha \lVert B_0 + \sum_i \alpha_i B_i - S \rVert^2 + \sum_i \gamma_i (\alpha_i - \alpha_i^*)^2,

    in turn, with falling :math:`\beta`: wrong weights are put right while the shapes are still the template's. Vertices
    that the template leaves still in a shape stay still. Separate parts of the head and contacts of lids and lips are
    held as in ``transfer_deformation``; how far they part is learned from the examples as triangles are. What no
    example shows is learned for no shape: have every shape in one, apart from others that move the same skin.

    Args:
        template: N shapes, V vertices, millimetres.
        neutral: the person at rest, in the template's topology.
        examples: the person's expressions, (M,V,3), in the template's topology and the neutral's place: the head's
            own motion taken out.
        weights: roughly what each example is in the template's shapes, (M,N), in [0,1].
        schedule: iterations, stiffness and pull; those of the paper if absent.
        contact_weight: as in ``transfer_deformation``.
        progress: called with each step and how far it is.

    Returns:
        The rig, in the neutral's dtype; solved in float64 on the CPU. The same input gives the same result.

    Raises:
        ShapeError: examples or weights have another shape, or there is no example.
        TopologyError: neutral, examples and template differ in topology.
        ValueRangeError: NaN or infinite numbers, weights outside [0,1], or a template without shapes.

    Source: thesis 3.3.3, equations 27 to 29; Li, Weise and Pauly 2010.

    Example:
        >>> y, x = torch.meshgrid(torch.linspace(-50, 50, 9), torch.linspace(-50, 50, 9), indexing="ij")
        >>> sheet = torch.stack([x, y, 50 - (x**2 + y**2) / 100], -1).reshape(-1, 3)
        >>> corner = torch.arange(72).reshape(8, 9)[:, :8].reshape(-1, 1)
        >>> neutral = Mesh.from_polygons(sheet, corner + torch.tensor([0, 1, 10, 9]))
        >>> bulge = torch.exp(-(x**2 + y**2) / 400).reshape(-1, 1) * torch.tensor([0.0, 2.0, 6.0])
        >>> template = BlendshapeRig(neutral, bulge[None], ["jawOpen"])
        >>> shown = sheet + 2 * bulge  # this person's goes twice as far
        >>> learned = rig_from_examples(template, neutral, shown[None], torch.ones(1, 1)).rig
        >>> 1.5 < (learned.deltas[0, 40, 2] / bulge[40, 2]).item() < 2.0  # under way to the person's own
        True
    """
    progress = progress or silent
    examples, weights = as_real(examples, "examples"), as_real(weights, "weights")
    _check(template, neutral, examples, weights, contact_weight)
    schedule = checked_type("schedule", schedule or RiggingSchedule(), RiggingSchedule)
    job = _Rigging(template, neutral, examples, weights, schedule, contact_weight)
    for number in range(job.schedule.iterations):
        beta, gamma = job.schedule.at(number)
        job.solve_shapes(beta)
        job.solve_weights(gamma)
        job.errors.append(job.example_errors())
        progress("learning from examples", number + 1, job.schedule.iterations)
    transfer = job.transfer
    return ExampleRig(
        rig=transfer.rig(template, neutral, job.prior + job.personal, job.correctives),
        weights=job.weights.to(weights),
        transferred=transfer.rig(template, neutral, job.prior, job.correctives),
        errors=torch.stack(job.errors) * float(transfer.similarity.scale[0]),
        angles=angles_between(job.prior, job.prior + job.personal),
        report=transfer_report(transfer, template.names),
    )


def angles_between(first: Tensor, second: Tensor) -> Tensor:
    """Angles between the directions of two sets of shapes (N,V,3), degrees, (N,); 0 where either is still."""
    a, b = first.double().flatten(1), second.double().flatten(1)
    length = a.norm(dim=-1) * b.norm(dim=-1)
    cosine = torch.where(length > 0, (a * b).sum(-1) / length.clamp(min=torch.finfo(torch.float64).tiny), 1.0)
    return torch.rad2deg(torch.arccos(cosine.clamp(-1, 1)))


class _Rigging:
    """The state that shapes and weights improve alternately, in the template's place and size, float64."""

    def __init__(
        self,
        template: BlendshapeRig,
        neutral: Mesh,
        examples: Tensor,
        weights: Tensor,
        schedule: RiggingSchedule,
        contact_weight: float,
    ) -> None:
        self.schedule = schedule
        self.transfer = ShapeTransfer(template, neutral, contact_weight)
        self.groups = self.transfer.groups()
        self.followers = {group[0]: self.transfer.follower(group[0]) for group in self.groups}
        faces = self.transfer.faces
        self.prior = self.transfer.transfer()
        self.personal = torch.zeros_like(self.prior)
        placed = self.transfer.similarity.inverse().apply(examples.detach().double().cpu())
        self.shown = placed - self.transfer.goal
        self.given = self.weights = weights.detach().double().cpu()
        self.correctives = self.transfer.correctives(template)
        self.activation = copy.deepcopy(template.activation)
        self.offsets = self._less_correctives()
        # What only the normals' columns of the gradients hold is not demanded of vertices; the rest is linear in them.
        self.operator = gradient_operator(self.transfer.goal, faces)
        self.prior_gradients = self._gradients(self.prior)
        self.example_gradients = self._gradients(self.offsets)
        self.compliance = self._compliance()
        self.vertex_compliance = self._vertex_means(self.compliance).T.contiguous()  # (V,N)
        self.left = self._left_by_transfer()
        self.errors = [self.example_errors()]

    def _less_correctives(self) -> Tensor:
        """What the shapes alone have to explain of the examples at their weights, (M,V,3)."""
        if self.activation is None or self.correctives is None:
            return self.shown
        return self.shown - torch.tensordot(self.activation.cpu()(self.weights), self.correctives.deltas, 1)

    def _left_by_transfer(self) -> float:
        """The squared distance between an example and the transferred rig's nearest pose, square millimetres.

        A person's own shapes are mostly stronger or weaker ones, which other weights of the transferred shapes fit
        as well. How far weights may leave the given ones is therefore measured by what no weights can fit.
        """
        least = _EXACT**2 * len(self.transfer.goal)
        shapes, offsets = self.prior.flatten(1), self.offsets.flatten(1)
        hessian = shapes @ shapes.T + least * torch.eye(len(shapes), dtype=torch.float64)
        best = box_qp(hessian, -(offsets @ shapes.T), start=self.given)
        return max(float((offsets - best @ shapes).square().sum(-1).mean()), least)

    def _gradients(self, displacements: Tensor) -> Tensor:
        """What displacements (K,V,3) add to the gradients of triangles, (K,F,9)."""
        columns = displacements.permute(1, 0, 2).flatten(1).numpy()
        rows = torch.from_numpy(self.operator @ columns).view(-1, 3, len(displacements), 3)
        return rows.permute(2, 0, 3, 1).flatten(2)

    def _compliance(self) -> Tensor:
        """1 / w, (N,F); 0 where a shape leaves a whole triangle still."""
        transfer = self.transfer
        poses = transfer.rest + transfer.deltas
        # One shape at a time: gradients of all would be the largest tensor of all.
        rows = [
            1 / shape_stiffness(gradients[None], self.schedule.kappa, self.schedule.theta)[0]
            for gradients in (
                deformation_gradients(transfer.rest, pose, transfer.faces) - torch.eye(3, dtype=torch.float64)
                for pose in poses
            )
        ]
        return torch.stack(rows) * transfer.moving[:, transfer.faces].any(-1)

    def _vertex_means(self, values: Tensor) -> Tensor:
        """The mean over the triangles around each vertex: (N,F) to (N,V)."""
        faces = self.transfer.faces
        sums = torch.zeros(len(values), len(self.transfer.goal), dtype=torch.float64)
        sums.index_add_(1, faces.T.flatten(), values.repeat(1, 3))
        return sums / torch.bincount(faces.flatten(), minlength=sums.shape[1]).clamp(min=1)

    def solve_shapes(self, beta: float) -> None:
        """Shapes at fixed weights: triangle by triangle what the examples show, then vertices that agree with it."""
        residuals = self.example_gradients - _combined(self.weights, self.prior_gradients)
        missing = (self.offsets - _combined(self.weights, self.prior)).transpose(0, 1).flatten(1).numpy()
        shares = example_shares(residuals, self.weights, self.compliance / beta)
        used = (self.weights > 0).any(0)
        self.personal = torch.zeros_like(self.prior)
        for group in self.groups:  # a loop over systems: shapes that move other vertices need another
            learning = [shape for shape in group if used[shape]]
            if not learning:
                continue
            more = personal_part(shares, self.weights[:, learning], self.compliance[learning] / beta)
            follower = self.followers[group[0]]
            apart = [self._offsets_between(pairs, learning, missing, beta) for pairs in follower.matrices]
            self.personal[learning] = follower.follow(more.unflatten(-1, (3, 3)), apart)

    def _offsets_between(self, pairs: sparse.csr_array, shapes: list[int], missing: np.ndarray, beta: float) -> Tensor:
        """How vertices that are tied or in contact move apart beyond the transfer, (G,K,3).

        A gap is one more thing to fit, as free to change as the skin on its two sides.
        """
        residuals = torch.from_numpy(pairs @ missing).view(-1, len(self.given), 3).transpose(0, 1)
        compliance = torch.from_numpy(0.5 * abs(pairs) @ self.vertex_compliance.numpy()).T / beta
        shares = example_shares(residuals, self.weights, compliance)
        return personal_part(shares, self.weights[:, shapes], compliance[shapes])

    def solve_weights(self, gamma: float) -> None:
        """Weights at fixed shapes: a quadratic program in [0,1] for each example."""
        shapes = (self.prior + self.personal).flatten(1)
        hold = gamma * self.left * torch.where(self.given > 0, 1.0, self.schedule.unnamed)
        pull = self.offsets.flatten(1) @ shapes.T + hold * self.given
        self.weights = box_qp(shapes @ shapes.T + hold.diag_embed(), -pull, start=self.weights)
        if self.correctives is not None:
            self.offsets = self._less_correctives()
            self.example_gradients = self._gradients(self.offsets)

    def example_errors(self) -> Tensor:
        missing = self.offsets - _combined(self.weights, self.prior + self.personal)
        return missing.square().sum(-1).mean(-1).sqrt()


def _combined(weights: Tensor, shapes: Tensor) -> Tensor:
    """Weighted sums of shapes, (M,N) and (N,...) to (M,...)."""
    return (weights @ shapes.flatten(1)).unflatten(1, shapes.shape[1:])


def _check(template: BlendshapeRig, neutral: Mesh, examples: Tensor, weights: Tensor, contact_weight: float) -> None:
    count, vertices = len(template.names), len(template.vertices)
    if count == 0:
        raise ValueRangeError("template: found 0 shapes, expected at least one")
    if len(template.neutral.faces) == 0:
        raise TopologyError("template: found no triangles, expected a mesh")
    if template.neutral.fingerprint() != neutral.fingerprint():
        raise TopologyError(
            f"neutral: found {len(neutral.vertices)} vertices and {len(neutral.faces)} triangles "
            f"({neutral.fingerprint()}), expected the template's topology of {vertices} vertices and "
            f"{len(template.neutral.faces)} triangles ({template.neutral.fingerprint()})"
        )
    if examples.ndim != 3 or examples.shape[-1] != 3:
        raise ShapeError(f"examples: found {tuple(examples.shape)}, expected (M,{vertices},3)")
    if len(examples) == 0:
        raise ShapeError("examples: found none, expected at least one; without any, use transfer_deformation")
    if examples.shape[1] != vertices:
        raise TopologyError(
            f"examples: found meshes of {examples.shape[1]} vertices, expected the template's {vertices}; "
            "register the scans to the template first"
        )
    if tuple(weights.shape) != (len(examples), count):
        raise ShapeError(
            f"weights: found {tuple(weights.shape)}, expected ({len(examples)},{count}): a row for each example, "
            "a column for each of the template's shapes"
        )
    for name, values in (("examples", examples), ("weights", weights), ("template", template.vertices)):
        if not torch.isfinite(values).all():
            bad = (~torch.isfinite(values)).flatten(1).any(1).nonzero()[:, 0].tolist()
            raise ValueRangeError(f"{name}: found NaN or infinite numbers in rows {bad[:5]}, expected none")
    if float(weights.min()) < 0 or float(weights.max()) > 1:
        outside = ((weights < 0) | (weights > 1)).any(1).nonzero()[:, 0].tolist()
        raise ValueRangeError(
            f"weights: found {float(weights.min()):.3g} to {float(weights.max()):.3g} (examples {outside[:5]}), "
            "expected 0 to 1"
        )
    if not 0 <= contact_weight < float("inf"):
        raise ValueRangeError(f"contact_weight: found {contact_weight}, expected a finite number of at least 0")

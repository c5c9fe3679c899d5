"""Modules behave as modules: what docs/concepts/modules.md says of each works, or is refused as it says there."""

import contextlib
import copy
import gc
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from module_examples import EXAMPLES, NAMES, Example, corrected_rig, corrected_solver, seen_markers
from pretended_device import pretended
from torch import Tensor, nn
from torch.utils._pytree import tree_leaves

from torchface import zoo
from torchface.errors import TraceError
from torchface.onnx.corrective_graph import CorrectiveGraph
from torchface.zoo.kinds import KINDS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "concepts" / "modules.md"
COLUMNS = (
    "to", "double", "load_state_dict", "deepcopy", "torch.save", "gradients", "vmap", "jacrev", "torch.compile",
    "torch.export",
)  # fmt: skip
ROUNDING = 1e-9

WRITTEN = (
    "ProjectedGradient", "WebcamSolver", "SolverGraph", "SolverGraph with predictions", "DynamicsPrior", "HeadModel",
    "LandmarkNetwork", "BoxNetwork",
)  # fmt: skip
"""Exported in the tests and benches of their ONNX graphs, which is more."""

LONG = (
    "WebcamSolver", "SolverGraph", "SolverGraph with predictions", "BoxNetwork", "PartNetwork", "LandmarkNetwork",
    "EnhancementModel", "EyeNetwork", "ActionUnitClassifier", "LandmarkTrees", "AdaptedDynamicsPrior", "WrinkleWeights",
)  # fmt: skip
"""Seconds to compile; the bench compiles them to machine code, and quick tests export all that run in one graph."""

IN_ONE_GRAPH = [name for name, example in EXAMPLES.items() if "torch.compile" not in example.cells]

# Everyday the marker solver shows what correctives change; the other takes as long as six classes.
every_class = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.bench if name == "HybridSolver with correctives" else ())
        for name in EXAMPLES
    ],
)


def outputs(example: Example, module: Any, *inputs: Tensor) -> list[Tensor]:
    found = example.call(module, *inputs)
    return [
        leaf for leaf in tree_leaves(list(found) if isinstance(found, tuple) else found) if isinstance(leaf, Tensor)
    ]


def fresh(example: Example, number: int = 0) -> Any:
    """An instance of the test's own, which has been used."""
    module = copy.deepcopy(example.make(number))
    outputs(example, module, *example.inputs())
    return module


def assert_same(found: list[Tensor], wanted: list[Tensor], tolerance: float = ROUNDING) -> None:
    assert len(found) == len(wanted) > 0
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(
            one, other, rtol=tolerance, atol=tolerance, equal_nan=True, check_dtype=False, check_device=False
        )


@pytest.mark.parametrize("name", ["WebcamSolver", pytest.param("VideoSolver", marks=pytest.mark.bench)])
def test_calls_leave_no_tensors_behind(name: str) -> None:
    example = EXAMPLES[name]
    module, inputs = fresh(example), example.inputs()

    def tensors() -> int:
        gc.collect()
        return sum(isinstance(found, Tensor) for found in gc.get_objects())

    before = tensors()
    for _ in range(3):
        outputs(example, module, *inputs)
    assert tensors() == before


# Pictures are shares of white, of which integers are 0 and 1 alone.
NO_INTEGERS = ("ActionUnitClassifier", "AppearanceModel", "LandmarkTrees", "LandmarkNetwork", "EyeNetwork")


@every_class
def test_whole_numbers_are_taken_for_floats(name: str) -> None:
    if name in NO_INTEGERS:
        pytest.skip("takes no whole numbers")
    example = EXAMPLES[name]
    module = fresh(example)
    whole = [part.nan_to_num(0.0).round() if part.is_floating_point() else part for part in example.inputs()]
    integers = [part.long() if part.is_floating_point() else part for part in whole]
    floats = [part.float() if part.is_floating_point() else part for part in whole]
    assert_same(outputs(example, module, *integers), outputs(example, module, *floats), 1e-4)


def numbers(example: Example, module: Any, first: Tensor, *rest: Tensor) -> Tensor:
    """A few sums of all that is computed, which the first input bears on."""
    found = [
        part.double().nan_to_num(0.0) for part in outputs(example, module, first, *rest) if part.is_floating_point()
    ]
    weights = [torch.linspace(1, 2, part.numel(), dtype=torch.float64).view(part.shape) for part in found]
    return torch.stack([(part * weight).sum() for part, weight in zip(found, weights, strict=True)])


@contextlib.contextmanager
def real() -> Iterator[str]:
    yield "cuda"


DEVICES = {"pretended": pretended, **({"cuda": real} if torch.cuda.is_available() else {})}


@every_class
@pytest.mark.parametrize("kind", DEVICES)
def test_it_moves_to_another_device(name: str, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """After use; no tensor is made elsewhere than where the inputs are. On a GPU too where there is one."""
    example = EXAMPLES[name]
    inputs, wanted = example.inputs(), outputs(example, example.make(0), *example.inputs())
    # Tensors of a class of one's own cannot be looked at in inference mode.
    monkeypatch.setattr(torch, "inference_mode", torch.no_grad)
    module = fresh(example)
    with DEVICES[kind]() as device, torch.no_grad():
        module.to(device)
        held = [*module.buffers(), *module.parameters()]
        assert {tensor.device.type for tensor in held} == {device}
        found = outputs(example, module, *(tensor.to(device) for tensor in inputs))
        assert {tensor.device.type for tensor in found} == {device}
        assert_same([tensor.cpu() for tensor in found], wanted, 1e-5)


@every_class
def test_it_goes_to_double_precision_and_back(name: str) -> None:
    """After use; what comes out is of that precision too, and near what came before."""
    example = EXAMPLES[name]
    inputs, module = example.inputs(), fresh(example)
    wanted = outputs(example, module, *inputs)
    for dtype in (torch.float64, torch.float32):
        module.to(dtype)
        held = [*module.buffers(), *module.parameters()]
        assert {tensor.dtype for tensor in held if tensor.is_floating_point()} == {
            torch.float64 if name == "WebcamSolver" else dtype
        }
        found = outputs(example, module, *(x.to(dtype) if x.is_floating_point() else x for x in inputs))
        kinds = {tensor.dtype for tensor in found if tensor.is_floating_point()}
        # A webcam's state is single and a helmet's motion double, whatever they compute in.
        assert name == "WebcamSolver" or kinds == {dtype, torch.float64 if name == "HelmetSolver" else dtype}
        assert_same(found, wanted, 1e-3)


@every_class
def test_a_state_that_is_loaded_after_use_takes_effect(name: str) -> None:
    """From a file, which holds no pickled classes, and assigned."""
    example = EXAMPLES[name]
    inputs, ours, theirs = example.inputs(), fresh(example, 0), fresh(example, 1)
    wanted, before = outputs(example, theirs, *inputs), outputs(example, ours, *inputs)
    torch.save(theirs.state_dict(), file := io.BytesIO())
    file.seek(0)
    for module, state, assign in (
        (copy.deepcopy(ours), torch.load(file, weights_only=True), False),
        (ours, theirs.state_dict(), True),
    ):
        module.load_state_dict(state, assign=assign)
        assert_same(outputs(example, module, *inputs), wanted)
    apart = [(a.double() - b.double()).abs().nan_to_num(0).max() for a, b in zip(before, wanted, strict=True)]
    assert max(apart) > 0.02


@every_class
def test_it_comes_back_from_config_and_state(name: str, tmp_path: Path) -> None:
    """Nothing else is needed, no rig; from a folder, if its class is a kind of the zoo's."""
    example = EXAMPLES[name]
    inputs, module = example.inputs(), fresh(example)
    if not hasattr(module, "from_config"):
        pytest.skip("is made by its constructor alone")
    if type(module) in KINDS.values():
        zoo.save_model(module, tmp_path / "kept", zoo.ModelCard("MIT", "made", {}, "none"))
        again = zoo.get_model(tmp_path / "kept")
    else:
        again = type(module).from_config(module.config)
        again.load_state_dict(module.state_dict())
    assert again.config == module.config
    assert_same(outputs(example, again, *inputs), outputs(example, module, *inputs))


@every_class
def test_a_deep_copy_is_on_its_own(name: str) -> None:
    example = EXAMPLES[name]
    inputs, module = example.inputs(), fresh(example)
    wanted = outputs(example, module, *inputs)
    copied = copy.deepcopy(module)
    assert_same(outputs(example, copied, *inputs), wanted)
    copied.load_state_dict(example.make(1).state_dict())
    assert_same(outputs(example, module, *inputs), wanted)


@every_class
def test_gradients_reach_its_input(name: str) -> None:
    example = EXAMPLES[name]
    module, (first, *rest) = example.make(0), example.inputs()
    asking = first.clone().requires_grad_()

    def slope() -> Tensor:
        return torch.autograd.grad(numbers(example, module, asking, *rest).sum(), asking)[0]

    if example.cells.get("gradients") == "no":
        with pytest.raises(
            (TraceError, RuntimeError), match=r"WholeTakeSolver: found|no autograd formula|not require grad"
        ):
            slope()
    else:
        assert float(slope().abs().nan_to_num(0).max()) > 0


@every_class
def test_vmap(name: str) -> None:
    example = EXAMPLES[name]
    module, inputs = example.make(0), example.inputs()
    several = [torch.stack([x, 0.9 * x]) for x in inputs]

    def mapped() -> tuple[Tensor, ...]:
        return torch.func.vmap(lambda *given: tuple(outputs(example, module, *given)))(*several)

    cell = example.cells.get("vmap", "yes")
    if cell == "batches":
        with pytest.raises(TraceError, match="expected a batch in place of vmap"):
            mapped()
    elif cell == "no":
        with pytest.raises(RuntimeError, match=r"vmap|functorch"):
            mapped()
    else:
        for i, found in enumerate(zip(*mapped(), strict=True)):
            assert_same(list(found), outputs(example, module, *(x[i] for x in several)), 3e-5)


@every_class
def test_jacobians(name: str) -> None:
    example = EXAMPLES[name]
    module, (first, *rest) = example.make(0), example.inputs()

    def computed(x: Tensor) -> Tensor:
        return numbers(example, module, x, *rest)

    cell = example.cells.get("jacrev", "yes")
    if cell == "yes":
        found = torch.func.jacrev(computed)(first)
        torch.testing.assert_close(found, torch.autograd.functional.jacobian(computed, first), equal_nan=True)
        return
    if name in ("ActionUnitClassifier", "LandmarkTrees"):  # steps
        assert not torch.func.jacrev(computed)(first).any()
        return
    with pytest.raises((TraceError, RuntimeError), match=r"in place of jacrev|autograd|WholeTakeSolver: found"):
        torch.func.jacrev(computed)(first)
    if cell == "jacobian":
        found = torch.autograd.functional.jacobian(computed, first)
        assert found.abs().nan_to_num(0).max() > 0
    outputs(example, module, first, *rest)  # nothing of the transform stays behind


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name not in LONG])
def test_compiled_it_computes_the_same(name: str) -> None:
    """In one graph, or with one gap in which it runs as ever; the graph is run as it is.

    The next test has those that take long, and what backends make of the graph.
    """
    check_compiled(EXAMPLES[name], name in IN_ONE_GRAPH, "eager")


@pytest.mark.bench
@pytest.mark.parametrize("name", sorted({*IN_ONE_GRAPH, *LONG}))
def test_compiled_to_machine_code_it_computes_the_same(name: str) -> None:
    check_compiled(EXAMPLES[name], name in IN_ONE_GRAPH, "inductor")


def check_compiled(example: Example, whole: bool, backend: str) -> None:
    module, inputs = example.make(0), example.inputs()
    torch.compiler.reset()
    compiled = torch.compile(Called(example, module), backend=backend, fullgraph=whole)
    with torch.no_grad():
        wanted = outputs(example, module, *inputs)
        for _ in range(2):
            assert_same(list(compiled(*inputs)), wanted, 1e-4 if backend == "inductor" else 1e-5)


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name not in WRITTEN])
def test_exported_it_computes_the_same(name: str) -> None:
    example = EXAMPLES[name]
    cell = example.cells.get("torch.export", "yes")
    if cell != "yes":
        with pytest.raises(TraceError, match="a trace would repeat one frame's path"):
            torch.export.export(Called(example, example.make(0)), example.inputs(), strict=False)
        return
    module, inputs = example.make(0), example.inputs()
    with torch.no_grad():
        program = torch.export.export(Called(example, module), inputs, strict=False)
        assert_same(list(program.module()(*inputs)), outputs(example, module, *inputs), 1e-5)


def exported_graphs() -> dict[str, tuple[Callable[[], nn.Module], Callable[[], tuple[Tensor, ...]]]]:
    """Those that stand in for solvers in the table without a row and a quick test in ONNX, of few steps."""
    none = torch.zeros(4, len(NAMES))
    return {
        "CorrectiveGraph": (
            lambda: CorrectiveGraph(corrected_solver(0), steps=1),
            lambda: (seen_markers(corrected_rig()).float(), none),
        ),
        "CorrectiveGraph with predictions": (
            lambda: CorrectiveGraph(corrected_solver(0), steps=1),
            lambda: (seen_markers(corrected_rig()).float(), none, none + 0.5, none + 1.0),
        ),
    }


@pytest.mark.bench  # ten seconds each
@pytest.mark.parametrize("kind", ["CorrectiveGraph", "CorrectiveGraph with predictions"])
def test_graphs_of_solvers_are_exported(kind: str) -> None:
    make, given = exported_graphs()[kind]
    graph, inputs = make(), given()
    with torch.no_grad():
        program = torch.export.export(graph, inputs, strict=False)
        assert_same(tree_leaves(program.module()(*inputs)), tree_leaves(graph(*inputs)), 1e-5)


@pytest.mark.parametrize(
    "name", ["BoxQP", "ProjectedGradient", "FixedSplitting", "ExpressionRegression", "ActionUnitClassifier"]
)
def test_no_samples_give_no_results(name: str) -> None:
    example = EXAMPLES[name]
    first, *rest = example.inputs()
    (some,), (none,) = (outputs(example, example.make(0), part, *rest) for part in (first, first[:0]))
    assert none.shape == (0, *some.shape[1:])


NETWORKS = ("LandmarkNetwork", "BoxNetwork", "EyeNetwork", "PartNetwork")


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name not in NETWORKS])
def test_autocast_has_no_effect_on_it(name: str) -> None:
    example, module = EXAMPLES[name], EXAMPLES[name].make(0)
    with torch.no_grad():
        wanted = outputs(example, module, *example.inputs())
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert_same(outputs(example, module, *example.inputs()), wanted, 1e-5)


class Called(nn.Module):
    """A network that holds the module."""

    def __init__(self, example: Example, module: nn.Module) -> None:
        super().__init__()
        self.call, self.module = example.call, module

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        found = self.call(self.module, *(1.0 * x for x in inputs))
        return (found,) if isinstance(found, Tensor) else tuple(leaf for leaf in found if isinstance(leaf, Tensor))


def table() -> str:
    """As the page has it."""
    heads = [f"`{column}`" if column != "gradients" else column for column in COLUMNS]
    rows = [["", *heads], ["---"] * (len(COLUMNS) + 1)]
    for name, example in EXAMPLES.items():
        first, _, more = name.partition(" with ")
        title = f"`{first}`" + (f" with {more}" if more else "")
        rows.append([title, *(example.cells.get(column, "yes") for column in COLUMNS)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def test_the_page_says_what_is_tested() -> None:
    assert table() in PAGE.read_text(), f"{PAGE}: expected the table\n{table()}"

"""Files built by chance, each of its format's parts but with values that disagree: strategies of hypothesis.

A strategy gives the files by name, the one to read first. Readers are tested alike::

    check_built(load_mesh, "built_meshes", "obj_files")
"""

import gc
import importlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.internal.conjecture import providers
from reader_budget import MEGABYTES, SECONDS, find_reader, limit_memory, place_of, run_child

Files = dict[str, bytes]

ODD_NUMBERS = (
    *("nan", "-nan", "inf", "-inf", "1e39", "1e400", "-1e308", "1e-320", "-0", "0x10", "1_0", "1,5", "", "-", "x"),
    *("9" * 25, "-" + "9" * 4400, "2147483648", "4294967296", "9223372036854775808", "١", "1e", "+1", "00", "1 "),
)
ODD_INTEGERS = (-1, 1, 2, 3, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32, 2**53, 2**63 - 1)
ODD_FLOATS = (0.5, -1.0, 1e9, 1e30, 1e39, -1e300, 1e-320, 1e308)
LINE_ENDS = ("\n", "\n", "\n", "\r\n", "\r")


def check_built(reader: Callable[[Path], Any], module: str, strategy: str, cases: int) -> None:
    """Drives a reader with built files in a child process; each must give a good value or a ``TorchfaceError``.

    Time and memory are those of the budget for small files; a case is shrunk before it is shown.

    Args:
        reader: a function of a path, at the top level of its module.
        module: of the function that gives the files.
        strategy: its name.
        cases: how many.

    Raises:
        AssertionError: a case escaped; the message holds it.
    """
    job = {**place_of(reader), "strategy": strategy, "strategies": module, "cases": cases}
    outcome = run_child(_run, job, 120 + SECONDS * cases)
    assert sum(outcome.values()) >= min(cases, 10), outcome


def _run(job: dict[str, Any], folder: Path) -> dict[str, int]:
    from torchface.errors import TorchfaceError

    reader, outcome, limited = find_reader(job), {"read": 0, "refused": 0}, [False]
    gc.freeze()  # Hypothesis collects garbage at its start: among all that is imported, that takes a third of a second
    if hasattr(providers, "_get_local_constants") and hasattr(providers, "_local_constants"):  # see tests/conftest.py
        providers._get_local_constants = lambda: providers._local_constants

    @settings(
        max_examples=job["cases"],
        database=None,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    @given(files=getattr(importlib.import_module(job["strategies"]), job["strategy"])())
    def check(files: Files) -> None:
        for name, data in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
        path = folder / next(iter(files))
        start = time.process_time()
        try:
            value = reader(path.parent if path.parent != folder else path)
        except TorchfaceError:
            outcome["refused"] += 1
        else:
            check_sound(value)
            outcome["read"] += 1
        taken = time.process_time() - start
        for name in files:
            (folder / name).unlink()
        if not limited[0]:  # imports, thread pools and caches are paid for before the limits hold
            limit_memory(MEGABYTES)
            limited[0] = True
        else:
            assert taken <= SECONDS, f"the case took {taken:.1f} s, expected at most {SECONDS} s"

    check()
    return outcome


def check_sound(value: Any) -> None:
    """Fails where a value holds an infinite number somewhere; NaN may stand for what was not seen."""
    if isinstance(value, torch.Tensor):
        assert not value.is_floating_point() or not bool(torch.isinf(value).any()), value
    elif isinstance(value, float):
        assert not math.isinf(value)
    elif is_dataclass(value):
        for field in fields(value):
            check_sound(getattr(value, field.name))
    elif isinstance(value, dict):
        for inner in value.values():
            check_sound(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            check_sound(inner)


def seldom(odd: st.SearchStrategy[Any], mostly: st.SearchStrategy[Any], one_in: int = 12) -> st.SearchStrategy[Any]:
    """Mostly the one, once in so many times the other."""
    return st.integers(1, one_in).flatmap(lambda drawn: odd if drawn == one_in else mostly)


def numbers(low: int = -3, high: int = 9) -> st.SearchStrategy[str]:
    """A number as text, seldom an odd one."""
    usual = st.integers(low, high).map(str) | st.floats(low, high, width=16).map(str)
    return seldom(st.sampled_from(ODD_NUMBERS), usual, 40)


def indices(high: int) -> st.SearchStrategy[str]:
    """A whole number as text, seldom an odd one."""
    return seldom(
        st.sampled_from(ODD_NUMBERS) | st.integers(-high, 3 * high).map(str), st.integers(1, high).map(str), 40
    )


def counts(true: int) -> st.SearchStrategy[int]:
    """Mostly the true count."""
    return seldom(st.sampled_from(ODD_INTEGERS) | st.integers(0, true + 3), st.just(true), 40)


def words(strategy: st.SearchStrategy[str], low: int, high: int | None = None) -> st.SearchStrategy[str]:
    """Some words of a line."""
    return st.lists(strategy, min_size=low, max_size=high or low).map(" ".join)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.sampled_from(ODD_INTEGERS)
    | st.integers(-2, 9)
    | st.sampled_from(ODD_FLOATS)
    | st.text(max_size=5)
    | st.sampled_from(["POSITION", "mm", "a.obj", "../a", "data:,", "\0", "VEC3", "nan"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@st.composite
def altered(draw: st.DrawFn, document: Any, most: int = 4) -> Any:
    """A document with up to so many of its values replaced, removed or said again."""
    document = json.loads(json.dumps(document))
    for _ in range(draw(st.integers(0, most))):
        parent, key = {"": document}, ""
        while (
            isinstance(value := parent[key], dict | list)
            and value
            and (parent[key] is document or draw(st.integers(0, 5)))
        ):
            parent, key = value, draw(st.sampled_from(sorted(value) if isinstance(value, dict) else range(len(value))))
        if parent.get("", None) is document if isinstance(parent, dict) else False:
            continue
        change = draw(st.sampled_from(["replace", "replace", "replace", "near", "remove", "again"]))
        value = parent[key]
        if change == "near" and isinstance(value, int | float):
            parent[key] = value + draw(st.integers(-2, 2))
        elif change == "remove":
            del parent[key]
        elif change == "again" and isinstance(parent, list):
            parent.append(value)
        else:
            parent[key] = draw(JSON)
    return document

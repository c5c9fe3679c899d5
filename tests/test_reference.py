"""Every public name stands in the reference, shows an example, and every error has its cures.

Public is what an ``__all__`` names.
"""

import importlib
import inspect
import re
from functools import cache
from pathlib import Path
from typing import Any

import torchface
from torchface import errors

LIBRARY = Path(torchface.__file__).resolve().parent
DOCS = Path(__file__).resolve().parents[1] / "docs"

OF_RECIPES = "train.model_cards.model_card"  # what recipes of one's own call beside the library

UNSHOWN = {
    "wants ICT-FaceKit's files": ("io.load_ict_facekit", "io.load_identity_modes"),
    "wants Blender": (
        "io.blender.BlenderScene",
        "io.blender.blender_program",
        "io.blender.read_blender_file",
        "io.blender.write_blender_file",
    ),
    "wants Node": ("workflows.browser_app.AppReport", "workflows.browser_app.export_app"),
    "wants a film of a painted face": (
        "capture.action_units.ActionUnitCurves",
        "capture.action_units.action_unit_curves",
        "capture.action_units.classify",
        "capture.action_units.read_regions",
        "onnx.export_action_units",
    ),
    "wants a textured scan, and seconds": (
        "landmarks.AutomaticLandmarks",
        "landmarks.FaceFrame",
        "landmarks.ScanLandmarks",
        "landmarks.scan_landmarks",
    ),
    "takes seconds": (
        "capture.markers.check_attachment",
        "capture.markers.sites_by_shape",
        "capture.own_rig.lighting.LightFit",
        "capture.own_rig.lighting.estimate_light",
        "landmarks.AppearanceFit",
        "landmarks.AppearanceModel",
        "onnx.export_dynamics_prior",
        "onnx.export_example_solver",
        "onnx.export_solver",
        "onnx.export_wrinkle_weights",
        "onnx.export_video_solver",
        "synthetic.stages.RawScan",
        "synthetic.stages.scan_head",
        "viz.modes_figure",
        "viz.random_figure",
        "viz.registration_sheet",
        "viz.site_views",
    ),
}
"""Names without an example, by why."""


@cache
def public_names() -> dict[str, Any]:
    """What each public path leads to."""
    names = {}
    for path in sorted(LIBRARY.rglob("*.py")):
        if "\n__all__ = " in path.read_text(encoding="utf-8"):
            parts = ("torchface", *path.relative_to(LIBRARY).with_suffix("").parts)
            module = importlib.import_module(".".join(parts).removesuffix(".__init__"))
            names.update({f"{module.__name__}.{name}": getattr(module, name) for name in module.__all__})
    return names


def resolved(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def key(path: str, thing: Any) -> object:
    """Equal for two ways to one thing; a plain value is itself only under its own path."""
    return path if isinstance(thing, str | float) else id(thing)


def own_docstrings(thing: Any) -> list[str]:
    members = vars(thing).values() if inspect.isclass(thing) else ()
    texts = [inspect.getdoc(thing) if not inspect.isclass(thing) else thing.__doc__]
    texts += [getattr(getattr(member, "__func__", member), "__doc__", None) for member in members]
    return [text for text in texts if isinstance(text, str)]


def shows_itself(thing: Any) -> bool:
    return any(">>> " in text for text in own_docstrings(thing))


def given_by_examples() -> set[str]:
    """Names of the classes that functions and methods with examples return: what they hold is shown there."""
    given = set()
    for thing in public_names().values():
        if inspect.isfunction(thing):
            functions = [thing]
        elif inspect.isclass(thing):
            members = (getattr(member, "__func__", member) for member in vars(thing).values())
            functions = [member for member in members if inspect.isfunction(member)]
        else:
            functions = []
        if shows_itself(thing):
            for function in functions:
                given.update(re.findall(r"\w+", str(function.__annotations__.get("return", ""))))
    return given


def test_every_public_name_stands_in_the_reference_once() -> None:
    wanted = {key(path, thing): path for path, thing in public_names().items()}
    text = "\n".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "reference").glob("*.md")))
    listed = re.findall(r"^\.\. (?:auto\w+|py:data):: (\S+)$", text, re.MULTILINE)
    keys = [key(path, resolved(path)) for path in listed]
    assert sorted({path for path, one in zip(listed, keys, strict=True) if keys.count(one) > 1}) == []
    assert sorted(path for one, path in wanted.items() if one not in keys) == []
    assert sorted(path for path, one in zip(listed, keys, strict=True) if one not in wanted) == [OF_RECIPES]


def test_every_public_class_and_function_has_an_example() -> None:
    given = given_by_examples()
    unshown = {f"torchface.{name}" for names in UNSHOWN.values() for name in names}
    homes: dict[int, str] = {}
    for path, thing in public_names().items():
        homes[id(thing)] = min(path, homes.get(id(thing), path), key=lambda one: (-one.count("."), one))
    lacking = {
        homes[id(thing)]
        for thing in public_names().values()
        if (inspect.isclass(thing) or inspect.isfunction(thing))
        and not shows_itself(thing)
        and thing.__name__ not in given
    }
    assert sorted(lacking - unshown) == []
    assert sorted(unshown - lacking) == []


def test_every_error_has_its_causes_and_cures() -> None:
    text = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    headings = re.findall(r"^#+ `(\w+)`$", text, re.MULTILINE)
    classes = [*errors.__all__, *(thing.__name__ for thing in public_names().values() if is_error(thing))]
    assert sorted(set(classes) - {"TorchfaceError"} - set(headings)) == []


def is_error(thing: Any) -> bool:
    return inspect.isclass(thing) and issubclass(thing, errors.TorchfaceError)

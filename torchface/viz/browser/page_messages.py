"""Messages that a page accepts from a browser: those that it is made for, with finite numbers and values that fit."""

import importlib
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import viser

_MAX_NUMBER = 1e6  # page units, pixels, indices: nothing on a page is larger
_MAX_TEXT = 200
_ROUNDING = 1e-6

Check = Callable[[Any], bool]


def _number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and abs(value) <= _MAX_NUMBER


def _whole(value: Any) -> bool:
    return type(value) is int and abs(value) <= _MAX_NUMBER


def _numbers(count: int) -> Check:
    return lambda value: type(value) is list and len(value) == count and all(map(_number, value))


def _text(value: Any) -> bool:
    return type(value) is str and len(value) <= _MAX_TEXT and value.isprintable()


def _plain(value: Any) -> bool:
    return value is None or type(value) is bool or _number(value) or _text(value)


def _or_none(check: Check) -> Check:
    return lambda value: value is None or check(value)


_POINT = _numbers(3)
_RAY: dict[str, Check] = {"ray_origin": _POINT, "ray_direction": _POINT, "modifier": _or_none(_text)}
_NODE: dict[str, Check] = {"name": _text, "instance_index": _or_none(_whole), "owner": _text}
_FIELDS: dict[str, dict[str, Check]] = {
    "ViewerCameraMessage": {
        **dict.fromkeys(("position", "look_at", "up_direction"), _POINT),
        **dict.fromkeys(("fov", "near", "far"), _number),
        **dict.fromkeys(("image_height", "image_width"), _whole),
        "wxyz": _numbers(4),
    },
    "ScenePointerMessage": {
        **_RAY,
        "event_type": lambda value: value == "click",
        "screen_pos": lambda value: type(value) is list and len(value) == 1 and _numbers(2)(value[0]),
    },
    "SceneNodeClickMessage": {**_RAY, **_NODE, "screen_pos": _numbers(2)},
    "SceneNodeDragMessage": {
        **_NODE,
        "phase": lambda value: value in ("start", "update", "end"),
        "button": lambda value: value in ("left", "middle", "right"),
        "modifier": _or_none(_text),
        **dict.fromkeys(("start_position", "end_position"), _POINT),
        **dict.fromkeys(("start_screen_pos", "end_screen_pos"), _numbers(2)),
    },
    "GuiUpdateMessage": {"uuid": _text, "updates": lambda value: type(value) is dict and set(value) == {"value"}},
}
"""The messages and what their fields must be. What is not here, uploads of files among it, no page of ours asks for."""


class MessageCheck:
    """Which messages a page takes; :meth:`watch` names the page, and before that no input takes a value."""

    def __init__(self) -> None:
        self._inputs: Mapping[str, Any] = {}

    def watch(self, server: "viser.ViserServer") -> None:
        """Holds values for the page's inputs against these inputs from now on."""
        self._inputs = server.gui._gui_input_handle_from_uuid

    def accepts(self, message: bytes | str) -> bool:
        """Whether a message, as it came, is one that the page is made for."""
        msgpack = importlib.import_module("msgspec.msgpack")
        if not isinstance(message, bytes):
            return False
        try:
            content = msgpack.decode(message)
        except (ValueError, RecursionError):  # no MessagePack; msgspec's errors are of the former
            return False
        if type(content) is not dict or type(kind := content.pop("type", None)) is not str or kind not in _FIELDS:
            return False
        # A later viser may say more than we read: of that, one plain value a field.
        checks = {**dict.fromkeys(content, _plain), **_FIELDS[kind]}
        if not all(name in content and check(content[name]) for name, check in checks.items()):
            return False
        return kind != "GuiUpdateMessage" or self._fits(self._inputs.get(content["uuid"]), content["updates"]["value"])

    @staticmethod
    def _fits(handle: Any, value: Any) -> bool:
        """Whether an input can have a value; none but those of the kinds that pages use has any."""
        viser = importlib.import_module("viser")
        if isinstance(handle, viser.GuiSliderHandle):
            margin = _ROUNDING * (handle.max - handle.min)
            return _number(value) and handle.min - margin <= value <= handle.max + margin
        if isinstance(handle, viser.GuiDropdownHandle | viser.GuiButtonGroupHandle):
            return value in handle.options
        if isinstance(handle, viser.GuiCheckboxHandle | viser.GuiButtonHandle):
            return type(value) is bool
        return isinstance(handle, viser.GuiTextHandle) and _text(value)

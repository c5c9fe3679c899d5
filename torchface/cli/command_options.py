"""Options of commands: their help in plain words, without a default that is none, and texts that are read as values."""

import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from dataclasses import dataclass, is_dataclass
from functools import wraps
from inspect import cleandoc, signature
from itertools import chain, takewhile
from pathlib import Path
from shutil import get_terminal_size
from textwrap import wrap
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TextIO, TypeVar, Union, get_args, get_origin, get_type_hints

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg
from tyro.constructors import PrimitiveConstructorSpec

from torchface.cli.terminal import console
from torchface.files.whole_files import check_there

_PATTERN = re.compile(r"[{}*?%\[\]]|:/")  # of a placeholder, of several files, or of an address
_WORDS = {Path: "PATH", str: "TEXT", int: "NUMBER", float: "NUMBER"}


@dataclass(frozen=True)
class Output:
    """The mark of an option that names what a command writes; every other path is an input, which is kept."""

    files: tuple[str, ...] = ()  # names of the files in it that a command writes, where it is a folder


OutputPath = Annotated[Path, Output()]
OptionalOutputPath = Annotated[Path | None, Output()]
"""A file or folder that a command writes; see :class:`Output`."""

Part = Annotated[str | None, arg(help="Keep this region of the rig only, such as face.")]

Reduce = Annotated[
    float | None,
    arg(
        help="Write as few keys as keep every frame's weights within this of straight lines between keys, such as "
        "0.001, in place of a key or a row for each frame."
    ),
]

Command = TypeVar("Command", bound=Callable[..., Any])


def checked(command: Callable[..., None]) -> Callable[..., None]:
    """The command with plain options, refused before any work where an input is missing or is an output too."""
    plain_options(command)

    @wraps(command)
    def run(*values: Any, **options: Any) -> None:
        given = signature(command).bind(*values, **options).arguments
        with inputs_kept(command, given):
            _check_inputs(command, given)
            if options.get("quiet") is False:  # of commands that take long, whose libraries alone take seconds to load
                console.print("starting")
            command(*values, **options)

    return run


def _check_inputs(command: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Raises ``FileFormatError`` where an input does not exist, before libraries are loaded, which takes seconds.

    One of many inputs, which a batch reports and skips, and names with placeholders are left to the command.
    """
    hints = get_type_hints(command, include_extras=True)
    for name, value in values.items():
        paths = [value] if isinstance(value, Path) else value if isinstance(value, tuple) and len(value) == 1 else []
        if _output(name, hints[name]) is not None:
            continue
        for path in paths:
            if isinstance(path, Path) and not _PATTERN.search(str(path)):
                check_there(path, "file or folder")


def inputs_kept(command: Callable[..., Any], values: Mapping[str, Any]) -> AbstractContextManager[None]:
    """What ``kept_inputs`` refuses, of a command or a dataclass of settings and the values of its options."""
    from torchface.files.input_files import kept_inputs

    inputs: list[Path] = []
    outputs: list[tuple[str, Path]] = []
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in signature(command).parameters.items():
        value = values.get(name, parameter.default)
        if (output := _output(name, hints[name])) is None:
            inputs += _paths(value)
            continue
        option = f"--{name.replace('_', '-')}"
        for path in _paths(value):
            outputs += [(option, path), *((option, path / file) for file in output.files)]
    return kept_inputs(inputs, outputs)


def _output(name: str, hint: Any) -> Output | None:
    """The mark of an option's type; ``out`` is an output without one."""
    marks = (note for note in getattr(hint, "__metadata__", ()) if isinstance(note, Output))
    return next(marks, Output() if name == "out" else None)


def _paths(value: Any) -> Iterator[Path]:
    if isinstance(value, (str, Path)):
        yield Path(value)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _paths(part)


@contextmanager
def wrapped_help(words: Sequence[str]) -> Iterator[None]:
    """Wraps what a help says above its options to the terminal's width, which tyro does not."""
    if {"-h", "--help"}.isdisjoint(words):
        yield
    else:
        with redirect_stdout(_Wrapping(sys.stdout)):  # type: ignore[type-var]
            yield


class _Wrapping:
    """A stream that wraps long lines between words; those with escape codes are usage and options."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        width, text = get_terminal_size().columns, re.sub(r"\n{3,}", "\n\n", text)
        lines = (
            wrap(line, width, break_long_words=False, break_on_hyphens=False)
            if len(line) > width and "\x1b" not in line
            else [line]
            for line in text.split("\n")
        )
        return self._stream.write("\n".join(chain.from_iterable(lines)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def one_line_each(text: str) -> str:
    """A docstring whose paragraphs and arguments are a line each: tyro keeps some of a text's line breaks."""
    return re.sub(r"(?<=\S)\n( {8,})?(?=\S)", " ", cleandoc(text))


def plain_options(command: Command) -> Command:
    """The command, or the dataclass, whose help says ``PATH`` instead of ``{None}|PATH (default: None)``."""
    command.__doc__ = one_line_each(command.__doc__ or "") or None
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in signature(command).parameters.items():
        kind, *notes = get_args(hints[name]) if get_origin(hints[name]) is Annotated else (hints[name],)
        named = any(getattr(note, "metavar", None) is not None for note in notes)
        empty = parameter.default is parameter.empty and _many(kind)
        empty = empty or parameter.default is None or parameter.default is False or parameter.default == ()
        changes: dict[str, Any] = {"help_behavior_hint": ""} if empty else {}
        if UseAppendAction in notes:  # one value for each time that it is given
            changes["metavar"] = _WORDS[get_args(kind)[0]]
        elif Positional in notes and not named:
            changes["metavar"] = name.upper() if parameter.default is parameter.empty else f"[{name.upper()}]"
        elif not named and (word := _word(kind)):
            changes["metavar"] = word
        if parameter.default is False and not is_dataclass(command):  # whose defaults may come from a file
            notes += get_args(FlagCreatePairsOff[bool])[1:]  # no --no-quiet
        if name == "out" and Positional not in notes:
            changes["aliases"] = ["-o"]
        if choices := _choices(kind):
            notes.append(choices)
        if changes or choices:
            hints[name] = Annotated[(kind, *notes, arg(**changes))]  # type: ignore[misc]
    command.__annotations__ = hints
    return command


def placed(command: Callable[..., Any], words: Sequence[str]) -> list[str]:
    """The words, in which what has a place and was given as a flag, such as ``--out`` of convert, stands there."""
    words, hints = list(words), get_type_hints(command, include_extras=True)
    notes = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    own = {getattr(note, "name", None) for row in notes.values() for note in row}  # options that are called as a place
    marked = {name: hint for name, hint in hints.items() if Positional in notes[name] and name not in own}
    for place, (name, hint) in enumerate(marked.items()):
        flags = (f"--{name.replace('_', '-')}", *(["-o"] if name == "out" else []))
        at = next((i for i, word in enumerate(words) if word.partition("=")[0] in flags), len(words))
        _, joined, value = "".join(words[at : at + 1]).partition("=")
        given = [value] if joined else [*_values(words[at + 1 :])]
        given = given if _many(get_args(hint)[0]) else given[:1]
        if given:
            del words[at : at + (1 if joined else 1 + len(given))]
            where = place if len([*_values(words)]) >= place else len(words)
            words[where:where] = given
    return words


def _values(words: Sequence[str]) -> Iterator[str]:
    """The words before the first flag."""
    return takewhile(lambda word: not word.startswith("-"), words)


def usage_hints(command: Callable[..., Any], words: Sequence[str]) -> Iterator[str]:
    """What tyro does not say of options that it refused: which are given again."""
    for name, hint in get_type_hints(command, include_extras=True).items():
        flag = f"--{name.replace('_', '-')}"
        for at, word in enumerate(words):
            values = [*_values(words[at + 1 :])]
            if UseAppendAction in getattr(hint, "__metadata__", ()) and word == flag and len(values) > 1:
                yield f"{flag} takes one value and is given again for each: {' '.join(f'{flag} {v}' for v in values)}"


def _choices(kind: Any) -> PrimitiveConstructorSpec[Any] | None:
    """How an option that may be left out takes one of several words; tyro lists None among them, in any order."""
    given = [option for option in get_args(kind) if option is not NoneType]
    if get_origin(kind) not in (Union, UnionType) or len(given) != 1 or get_origin(given[0]) is not Literal:
        return None
    values = {str(value): value for value in get_args(given[0])}
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(values) + "}",
        instance_from_str=lambda words: values[words[0]],
        is_instance=lambda value: value is None or value in values.values(),
        str_from_instance=lambda value: [str(value)],
        choices=tuple(values),
    )


def _many(kind: Any) -> bool:
    """Whether an option takes several values; tyro takes none of them for a default."""
    return get_origin(kind) in (list, tuple)


def _word(kind: Any) -> str | None:
    """What an option takes where it is given, if there is one word for it."""
    given = [kind]
    if get_origin(kind) in (Union, UnionType):
        given = [option for option in get_args(kind) if option is not NoneType]
    if len(given) != 1:
        return None
    if get_origin(given[0]) is Literal:
        return "{" + ",".join(map(str, get_args(given[0]))) + "}"
    if _many(given[0]) and (word := _WORDS.get(get_args(given[0])[0])):
        return f"[{word} ...]"
    return _WORDS.get(given[0])


def picture_size(text: str) -> tuple[int, int]:
    """Width and height of a text such as 1280x720.

    Raises:
        ValueRangeError: it is no such text.
    """
    from torchface.errors import ValueRangeError

    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text.strip().lower())
    if match is None or not (int(match[1]) and int(match[2])):
        raise ValueRangeError(f"--size: found {text[:40]!r}, expected WIDTHxHEIGHT in pixels, such as 1280x720")
    return int(match[1]), int(match[2])

"""Every command refuses an output that is one of its inputs, before any work, and leaves the input as it was."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from inspect import Parameter, getdoc, signature
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest
import torch
import tyro
from tyro.conf import arg

from torchface import BlendshapeRig, Take, Track, save_animation, save_rig
from torchface.cli import COMMANDS, GROUPS, main
from torchface.cli.command_options import Output, checked, placed
from torchface.cli.export import export_model
from torchface.io import save_mesh
from torchface.synthetic import neutral_head

ALL = {
    **{(name,): command for name, command in COMMANDS.items()},
    **{(name, second): command for name, group in GROUPS.items() for second, command in group.commands.items()},
    ("export",): export_model,
}
WRITES = re.compile(
    r"to write|[Aa]lso write|[Aa]lso draw|Folder for|folder (to|for)|into this folder|Where Save writes"
)


@dataclass(frozen=True)
class Option:
    name: str
    hint: Any
    parameter: Parameter

    @property
    def output(self) -> Output | None:
        return next((note for note in getattr(self.hint, "__metadata__", ()) if isinstance(note, Output)), None)

    @property
    def holds(self) -> set[type]:
        """The kinds of values in its type, such as Path."""
        return set(kinds(self.hint))

    def words(self, value: str) -> list[str]:
        notes = getattr(self.hint, "__metadata__", ())
        if self.parameter.kind is Parameter.POSITIONAL_ONLY or tyro.conf.Positional[int].__metadata__[0] in notes:
            return [value]
        named = [note.name for note in notes if isinstance(note, type(arg())) and note.name]
        return [f"--{(named or [self.name.replace('_', '-')])[0]}", value]


def kinds(hint: Any) -> Iterator[type]:
    for part in get_args(hint)[: 1 if hasattr(hint, "__metadata__") else None]:
        yield from kinds(part)
    if get_origin(hint) is None and isinstance(hint, type):
        yield hint


def options_of(command: Any) -> list[Option]:
    hints = get_type_hints(command, include_extras=True)
    return [Option(name, hints[name], parameter) for name, parameter in signature(command).parameters.items()]


def inputs_of(command: Any) -> list[Option]:
    return [option for option in options_of(command) if Path in option.holds and option.output is None]


CASES = [
    (words, command, output, given)
    for words, command in ALL.items()
    for output in options_of(command)
    if output.output is not None
    for given in inputs_of(command)
]


def words_for(words: tuple[str, ...], command: Any, values: dict[str, Path], folder: Path) -> list[str]:
    """A command line with values of some options, and plausible ones of all others that must be given."""
    line = list(words)
    positional, named = [], []
    for option in options_of(command):
        if option.name in values:
            value = str(values[option.name])
        elif option.parameter.default is not Parameter.empty:
            continue
        elif Path in option.holds:
            other = folder / f"other_{option.name}.glb"
            if option.output is None:
                other.write_bytes(b"other")
            value = str(other)
        else:
            value = "9" if int in option.holds else "name"
        given = option.words(value)
        (positional if len(given) == 1 else named).append(given)
    return line + [word for words in (*positional, *named) for word in words]


def test_the_commands_are_looked_through() -> None:
    assert len(CASES) > 60
    assert {words for words, *_ in CASES} >= {("solve",), ("retarget",), ("convert",), ("export", "solver"), ("view",)}


@pytest.mark.parametrize("words", ALL)
def test_what_a_help_text_calls_written_is_marked_as_an_output(words: tuple[str, ...]) -> None:
    command = ALL[words]
    text = getdoc(command) or ""
    for option in options_of(command):
        found = re.search(rf"^\s+{option.name}: (.*(?:\n {{8,}}.*)*)", text, re.MULTILINE)
        if Path in option.holds and found is not None and (option.name == "out" or WRITES.search(found[1])):
            assert option.output is not None, f"torchface {' '.join(words)}: {option.name}: OutputPath"


@pytest.mark.parametrize(
    ("words", "command", "output", "given"),
    CASES,
    ids=lambda value: getattr(value, "name", "_".join(map(str, value)) if isinstance(value, tuple) else ""),
)
def test_an_output_that_is_an_input_is_refused_before_any_work(
    words: tuple[str, ...], command: Any, output: Option, given: Option, tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    path = tmp_path / "same.csv"
    path.write_bytes(b"content")
    said = messages_of(*words_for(words, command, {output.name: path, given.name: path}, tmp_path), status=2)
    assert "is the input" in said
    assert path.read_bytes() == b"content"


def test_o_is_short_for_out(tmp_path: Path) -> None:
    save_mesh(neutral_head(texture=False), tmp_path / "head.obj")
    main(["render", str(tmp_path / "head.obj"), "-o", str(tmp_path / "head.png"), "--height", "64", "--yaw", "0"])
    assert (tmp_path / "head.png").is_file()


def test_a_file_with_an_animation_that_is_rendered_at_rest_names_the_way_to_a_frame(
    dome_rig: BlendshapeRig, tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    take = Take(30.0, weights=Track(dome_rig.names[:1], torch.linspace(0, 1, 5)[:, None, None]))
    save_animation(dome_rig, take, tmp_path / "take.glb")
    save_rig(dome_rig, tmp_path / "rig.glb")
    small = ("--height", "64", "--yaw", "0", "--quiet")
    for name, more, said in (("rig", (), False), ("take", (), True), ("take", ("--take", "take.glb"), False)):
        more = tuple(str(tmp_path / word) if word.endswith(".glb") else word for word in more)
        assert (
            "is shown at rest"
            in messages_of("render", tmp_path / f"{name}.glb", "--out", tmp_path / "a.png", *small, *more)
        ) == said


def test_a_frame_without_a_take_is_refused(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    save_mesh(neutral_head(texture=False), tmp_path / "head.obj")
    assert "--frame: found 4 without a take" in messages_of(
        "render", tmp_path / "head.obj", "--out", tmp_path / "head.png", "--frame", "4", status=2
    )


@pytest.mark.parametrize("command", ["enhance", "register", "render"])
def test_the_help_names_what_a_command_takes_and_no_empty_default(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "(default: )" not in printed
    assert "--no-no" not in printed
    assert command != "register" or "TEMPLATE SCAN..." in printed
    assert command != "render" or "(default: 0)" in printed  # of --frame


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("words", [*ALL, ("train", "morphable"), ("zoo",)])
def test_help_fills_the_lines_of_a_terminal(
    words: tuple[str, ...], width: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert max(map(len, lines)) <= width
    below = re.compile(r" {6,}\S")  # goes on from the line above
    for line, following in pairwise(lines):
        if below.match(line) and below.match(following):
            word = following.split()[0]
            assert len(line) + 1 + len(word) > width - 2, (line, following)


@pytest.mark.parametrize(
    ("command", "option"), [("live", "--to TEXT"), ("track", "--video PATH"), ("calibrate", "--beside PATH")]
)
def test_the_help_shows_one_value_where_an_option_is_given_again_for_each(
    command: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert option in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("command", "places"), [("view", "RIG [WEIGHTS]"), ("pick", "MESH [SCAN]"), ("convert", "FILE OUT")]
)
def test_the_help_calls_every_place_by_its_own_name(
    command: str, places: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    assert re.search(rf"usage: torchface {command} .*{re.escape(places)}", " ".join(capsys.readouterr().out.split()))


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        ("live 0 --to osc://a:1 vmc://b:2", "again for each: --to osc://a:1 --to vmc://b:2"),
        ("convert a.obj b.glb --out c.glb", "Unrecognized options: b.glb"),
    ],
)
def test_an_option_given_in_the_way_of_another_is_refused_with_the_right_way(
    words: str, hint: str, messages_of: Callable[..., str]
) -> None:
    assert hint in messages_of(*shlex.split(words), status=2)


@pytest.mark.parametrize(
    ("words", "right"),
    [
        ("convert a.obj --out b.glb", "a.obj b.glb"),
        ("convert a.obj --at jawOpen=1 -o b.glb", "a.obj b.glb --at jawOpen=1"),
        ("convert --unit cm a.obj --out=b.glb", "--unit cm a.obj b.glb"),
        ("export solver --attachment a.json --rig r.glb --out o.onnx", "r.glb --attachment a.json --out o.onnx"),
        ("export action-units --model units -o o.onnx", "units -o o.onnx"),
        ("register s.obj t.obj --template r.glb --out o", "r.glb s.obj t.obj --out o"),
        ("solve r.glb --take a.c3d b.c3d --out o.csv", "r.glb a.c3d b.c3d --out o.csv"),
        ("solve r.glb a.c3d --out o.csv", "r.glb a.c3d --out o.csv"),
        ("convert a.obj --out", "a.obj --out"),
        ("track --video l.mp4 --video r.mp4 --out o.csv", "--video l.mp4 --video r.mp4 --out o.csv"),
    ],
)
def test_what_has_a_place_may_be_given_as_a_flag(words: str, right: str) -> None:
    one, *rest = words.split()
    command = COMMANDS[one] if one in COMMANDS else GROUPS[one].commands[rest.pop(0)]
    assert placed(command, rest) == right.split()


def test_every_command_s_output_may_be_given_as_out(tmp_path: Path) -> None:
    save_mesh(neutral_head(texture=False), tmp_path / "head.obj")
    main(["convert", str(tmp_path / "head.obj"), "--out", str(tmp_path / "head.ply"), "--quiet"])
    assert (tmp_path / "head.ply").is_file()
    for words, command in ALL.items():
        written = [option.name for option in options_of(command) if option.output is not None]
        assert "out" in written or words[-1] in ("live", "info", "list", "describe", "verify"), words


def test_a_wrong_word_is_refused_with_the_right_ones_in_their_order(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["attach", "--unit", "yard"])
    printed = capsys.readouterr()
    words = " ".join(word for word in (printed.out + printed.err).split() if word != "│")
    assert "Expected one of ('um', 'mm', 'cm', 'm', 'in')." in words


@pytest.mark.parametrize("kind", ["symbolic link", "hard link", "link to the folder", "way round"])
def test_another_name_of_the_same_file_is_the_same(kind: str, tmp_path: Path, messages_of: Callable[..., str]) -> None:
    folder = tmp_path / "takes"
    folder.mkdir()
    take, other = folder / "take.csv", folder / "other.csv"
    take.write_text("frame,time,jawOpen\n0,0,0.5\n")
    if kind == "symbolic link":
        other.symlink_to(take)
    elif kind == "hard link":
        os.link(take, other)
    elif kind == "link to the folder":
        (tmp_path / "linked").symlink_to(folder)
        other = tmp_path / "linked" / "take.csv"
    else:
        other = tmp_path / "takes" / ".." / "takes" / "take.csv"
    rig = tmp_path / "rig.glb"
    rig.write_bytes(b"no rig is read")
    assert "is the input" in messages_of("retarget", take, "--to", rig, "--out", other, status=2)
    assert take.read_text().startswith("frame")


def test_a_missing_input_is_said_before_torch_is_loaded() -> None:
    for words in (["fit", "none.png", "--out", "x.glb"], ["track", "none.mp4", "--out", "out"], ["info", "none.glb"]):
        code = f"import sys; from torchface.cli import main\ntry: main({words})\nfinally: print('torch' in sys.modules)"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.stdout == "False\n"
        assert f"{words[1]}: found no such file or folder, expected an existing one" in " ".join(done.stderr.split())


def test_two_outputs_of_one_name_are_refused(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    take = tmp_path / "take.csv"
    take.write_text("frame,time,jawOpen\n0,0,0.5\n")
    both = ("--out", str(tmp_path / "out.csv"), "--live-link", str(tmp_path / "out.csv"))
    assert "--out names too" in messages_of("retarget", take, "--to", tmp_path / "rig.glb", *both, status=2)


def test_a_file_that_a_command_writes_into_its_folder_is_refused_as_an_input(
    tmp_path: Path, messages_of: Callable[..., str]
) -> None:
    landmarks = tmp_path / "landmarks.csv"
    landmarks.write_text("frame,timestamp,confidence,success,x_0,y_0\n1,0,1,1,2,3\n")
    assert "landmarks.csv, which is the input" in messages_of(
        "track", "--rig", tmp_path / "rig.glb", "--landmarks", landmarks, "--out", tmp_path, status=2
    )


def test_the_check_leaves_the_command_as_it_is() -> None:
    def command(source: Path, out: Path = Path("out.csv")) -> None:
        """Does nothing."""

    assert signature(checked(command)) == signature(command)
    assert checked(command).__doc__ == "Does nothing."


def test_a_recipe_refuses_the_folder_that_it_learns_from(tmp_path: Path, messages_of: Callable[..., str]) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "linked").symlink_to(tmp_path / "data")
    assert "linked, which is the input" in messages_of(
        "train", "appearance", "--data", tmp_path / "data", "--out", tmp_path / "linked", status=2
    )
    assert not list((tmp_path / "data").iterdir())

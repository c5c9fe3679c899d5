"""The ``torchface`` command; one file a subcommand."""

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import tyro
from rich.table import Table
from rich.text import Text

from torchface import __version__
from torchface.cli.annotate import annotate
from torchface.cli.arkit import arkit
from torchface.cli.attach import attach
from torchface.cli.calibrate import calibrate
from torchface.cli.command_options import checked, placed, usage_hints, wrapped_help
from torchface.cli.convert import convert
from torchface.cli.corrective import corrective
from torchface.cli.demo import demo
from torchface.cli.enhance import enhance
from torchface.cli.evaluate import evaluate
from torchface.cli.examples import examples
from torchface.cli.export import EXPORTS, export_model
from torchface.cli.fit import fit
from torchface.cli.info import info
from torchface.cli.live import live
from torchface.cli.pick import pick
from torchface.cli.register import register
from torchface.cli.relight import relight
from torchface.cli.render import render
from torchface.cli.retarget import retarget
from torchface.cli.retime import retime
from torchface.cli.rig_command import rig
from torchface.cli.solve import solve
from torchface.cli.terminal import PlainConsole, count_interrupts_once, plain_errors, print_lines
from torchface.cli.track import track
from torchface.cli.train import train
from torchface.cli.transfer import transfer
from torchface.cli.view import view
from torchface.cli.zoo import ZOO
from torchface.errors import NameMismatchError

COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "register": register,
    "rig": rig,
    "arkit": arkit,
    "fit": fit,
    "transfer": transfer,
    "corrective": corrective,
    "attach": attach,
    "solve": solve,
    "track": track,
    "relight": relight,
    "examples": examples,
    "live": live,
    "retarget": retarget,
    "retime": retime,
    "enhance": enhance,
    "evaluate": evaluate,
    "calibrate": calibrate,
    "convert": convert,
    "render": render,
    "info": info,
    "view": view,
    "pick": pick,
    "annotate": annotate,
}


@dataclass(frozen=True)
class Group:
    """Commands of two words, such as `torchface export solver`."""

    summary: str  # a line for the overview
    description: str  # above the group's own help
    commands: dict[str, Callable[..., None]]  # by their second word


GROUPS = {
    "export": Group(
        "Write an ONNX graph of a solver or of a model of the zoo: `torchface export --help`.",
        "Write an ONNX graph: of your own solver, as below, or of a learned model by its name or folder, as in "
        "`torchface export head --out head.onnx`.",
        EXPORTS,
    ),
    "zoo": Group(
        "List the learned models there are and whether they are undamaged: `torchface zoo --help`.",
        "What learned models there are, what is known of them, and whether they are undamaged.",
        ZOO,
    ),
}
DESCRIPTION = "Learn face rigs from scans, solve performances with them, ship them as ONNX and glTF."


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs one command; an error that the user can mend ends with its message and exit status 2."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        count_interrupts_once()
    with plain_errors(), wrapped_help(words):
        if words in (["--version"], ["-V"]):
            print(f"torchface {__version__}")
            raise SystemExit(0)
        if not words or words in (["--help"], ["-h"]):
            _overview("torchface", DESCRIPTION, _summaries())
            raise SystemExit(0 if words else 2)
        _check_command(words[0])
        if words[:1] == ["export"] and words[1:] and words[1] not in EXPORTS and not words[1].startswith("-"):
            _run(export_model, "torchface export", words[1:])
        elif words[0] == "train":
            train(words[1:])
        elif words[0] in COMMANDS:  # alone: what tyro says of a wrong value then names its help
            _run(COMMANDS[words[0]], f"torchface {words[0]}", words[1:])
        elif words[0] in GROUPS:
            group, name = GROUPS[words[0]], f"torchface {words[0]}"
            if words[1:] in ([], ["--help"], ["-h"]):
                _overview(name, group.description, {one: run.__doc__ or "" for one, run in group.commands.items()})
                raise SystemExit(0 if words[1:] else 2)
            if words[1] in group.commands:
                _run(group.commands[words[1]], f"{name} {words[1]}", words[2:])
            else:
                _run_one_of(group.commands, name, words[1:])
        else:
            _run_one_of(COMMANDS, "torchface", words)


def _run(command: Callable[..., None], name: str, words: Sequence[str]) -> None:
    """Runs a command, and says of options that were refused what tyro does not."""
    try:
        tyro.cli(checked(command), prog=name, args=placed(command, words))
    except SystemExit as end:
        if end.code:
            print_lines(usage_hints(command, words))
        raise


def _run_one_of(commands: Mapping[str, Callable[..., None]], name: str, words: Sequence[str]) -> None:
    """Runs the command that the words name, somewhere among options, or says which there are."""
    ready = {one: checked(command) for one, command in commands.items()}
    tyro.extras.subcommand_cli_from_dict(ready, prog=name, args=words)


def _check_command(word: str) -> None:
    """Raises ``NameMismatchError`` where a first word is no command."""
    names = [*COMMANDS, *GROUPS, "train"]
    if not word.startswith("-") and word not in names:
        from torchface.shape_names import near_names  # brings torch

        raise NameMismatchError(
            f"found the command {word!r:.40}, expected one: {near_names([word], names, len(names))}"
        )


def _summaries() -> dict[str, str]:
    own = {name: command.__doc__ or "" for name, command in COMMANDS.items()}
    return own | {name: group.summary for name, group in GROUPS.items()} | {"train": train.__doc__ or ""}


def _overview(name: str, description: str, commands: Mapping[str, str]) -> None:
    """A line a command, the beginning of its text; tyro would print the whole of each."""
    table = Table(box=None, show_header=False, padding=(0, 2))
    for one, text in commands.items():
        summary = " ".join(text.partition("\n\n")[0].split())
        table.add_row(Text(one, "bold"), re.split(r"[:;,.](?:\s|$)", summary)[0])
    page = PlainConsole(stderr=False)
    page.print(f"{name}: {description}\n", highlight=False)
    page.print(table, highlight=False)
    version = "; torchface --version" if name == "torchface" else ""
    page.print(f"\n{name} COMMAND --help shows more of each{version}.", highlight=False)

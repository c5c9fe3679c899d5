"""Commands that cannot go on end with a line, not with a traceback."""

import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from matplotlib.figure import Figure
from rich.table import Table

from torchface import BlendshapeRig, save_mesh, save_rig, save_take, zoo
from torchface.capture import ShapePrior
from torchface.cli import main
from torchface.cli.terminal import PlainConsole, plain_errors, print_path
from torchface.errors import FileFormatError
from torchface.files.whole_files import check_writable, make_folder
from torchface.rendering.compositing import from_figure
from torchface.synthetic.stages import place_markers, record


@pytest.fixture(scope="module")
def stage(dome_rig: BlendshapeRig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a rig, an attachment, a take, and a file where a folder might be expected."""
    folder = tmp_path_factory.mktemp("stage")
    sites = place_markers(dome_rig, 30)
    sites.save(folder / "attachment.json")
    save_rig(dome_rig, folder / "rig.glb")
    save_take(record(dome_rig, sites, torch.zeros(5, 4), torch.Generator().manual_seed(0)).take, folder / "take.c3d")
    (folder / "file").write_text("no folder")
    return folder


@pytest.mark.parametrize("option", ["--report", "--out", "--animation", "--live-link"])
def test_a_place_that_cannot_be_written_to_is_named_before_the_solve(
    stage: Path, option: str, messages_of: Callable[..., str]
) -> None:
    words = ["solve", stage / "rig.glb", stage / "take.c3d", "--attachment", stage / "attachment.json", "--quiet"]
    outs = {"--out": stage / "weights.csv", option: stage / "file" / "here.csv"}
    assert f"{stage / 'file' / 'here.csv'}: cannot be written" in messages_of(
        *words, *(word for pair in outs.items() for word in pair), status=2
    ).replace("\n", "")
    assert not (stage / "weights.csv").exists()


@pytest.mark.parametrize(
    ("words", "ending"),
    [
        ("solve rig.glb take.c3d --attachment a.json --out w.xlsx", ".csv"),
        ("solve rig.glb take.c3d --attachment a.json --out w.csv --live-link w.xlsx", ".csv"),
        ("solve rig.glb take.c3d --attachment a.json --out w.csv --animation w.xlsx", ".glb"),
        ("retarget take.csv --to rig.glb --out w.xlsx", ".csv"),
        ("attach rig.glb take.c3d --out w.xlsx", ".json"),
        ("attach rig.glb take.c3d --picture w.xlsx", ".png"),
        ("calibrate board.png --out w.xlsx", ".toml"),
        ("examples --rig rig.glb --out w.xlsx", ".json"),
        ("render rig.glb --out w.xlsx", ".png"),
        ("rig scan.obj --template rig.glb --out w.xlsx", ".glb"),
        ("fit photo.png --model head --out w.xlsx", ".glb"),
        ("transfer rig.glb neutral.obj --out w.xlsx", ".glb"),
        ("convert rig.glb w.xlsx", ".glb"),
        ("export solver --rig rig.glb --attachment a.json --out w.xlsx", ".onnx"),
        ("export examples --examples e.json --out w.xlsx", ".onnx"),
        ("export webcam --out w.xlsx", ".onnx"),
        ("export head --out w.xlsx", ".onnx"),
    ],
)
def test_a_result_of_another_ending_is_refused_before_anything_is_read(
    words: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, messages_of: Callable[..., str]
) -> None:
    monkeypatch.chdir(tmp_path)
    inputs = {Path(word) for word in words.split() if "." in word and not word.startswith("w.")}
    for path in inputs:
        path.touch()  # which nothing could be read from
    told = messages_of(*words.split(), status=2)
    assert f"w.xlsx: found the ending '.xlsx', expected {ending}" in told
    assert {path.relative_to(tmp_path) for path in tmp_path.iterdir()} == inputs


@pytest.mark.parametrize(
    "words", ["render rig.glb --out", "export solver --rig rig.glb --attachment attachment.json --out"]
)
def test_a_missing_folder_of_a_result_is_made(
    stage: Path, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, coarse_figures: None
) -> None:
    def exported(_: object, path: Path, *__: object, **___: object) -> SimpleNamespace:
        path.write_bytes(b"an export takes twenty seconds")
        return SimpleNamespace(rows=list, verdict=str)

    monkeypatch.setattr("torchface.onnx.solver_graph_export.export_marker_solver", exported)
    monkeypatch.chdir(stage)
    out = tmp_path / "new" / ("a.png" if words.startswith("render") else "a.onnx")
    main([*words.split(), str(out), "--quiet"])
    assert out.is_file()


def test_folders_are_made_or_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    assert make_folder(tmp_path / "a" / "b").is_dir()
    check_writable(None, tmp_path / "c" / "d.csv")
    assert not (tmp_path / "c").exists()
    for refused in (make_folder, check_writable):
        with pytest.raises(FileFormatError, match=r"file.b: (found no folder|cannot be written)"):
            refused(tmp_path / "file" / "b")


def test_what_a_system_call_says_is_told_with_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended, plain_errors():
        raise PermissionError(13, "Permission denied", "/some/file")
    assert ended.value.code == 2
    assert "error: /some/file: Permission denied" in capsys.readouterr().err
    with pytest.raises(OSError, match="nobody's"), plain_errors():
        raise OSError("nobody's")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["fit", "--prior", "head"], "--prior: found head, a HeadModel"),
        (["fit", "--prior=head"], "--prior: found head, a HeadModel"),
        (["fit", "head", "--prior", "other"], "model: found head, a HeadModel"),
    ],
)
def test_a_model_of_another_kind_is_named_by_the_flag_that_gave_it(
    given: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["torchface", *given])
    with pytest.raises(SystemExit), plain_errors():
        zoo.get_model("head", ShapePrior)
    assert f"error: {said}" in capsys.readouterr().err


def test_a_folder_that_was_given_keeps_its_name_beside_a_flag_of_the_same_value(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["torchface", "train", "expression", "--pairs", "people", "--pictured", "1"])
    with pytest.raises(SystemExit), plain_errors():
        raise FileFormatError("people: found 1 person, expected at least three")
    assert "error: people: found 1 person" in capsys.readouterr().err


def test_a_warning_is_one_line_without_the_sources_path() -> None:
    as_before = warnings.formatwarning
    said = UserWarning("hat.vrm: left out:\nlights \x1b[2J")
    with plain_errors():
        lines = [warnings.formatwarning(said, UserWarning, "source.py", 58) for _ in range(2)]
    assert lines == ["warning: hat.vrm: left out: lights \\x1b[2J\n", ""]
    assert warnings.formatwarning is as_before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])  # Ctrl-C, kill, a terminal that is closed
def test_what_stops_a_command_lets_it_write_first(name: str) -> None:
    program = (
        "import atexit, os, signal, sys, torchface.cli as cli\n"
        # A shell's background job ignores Ctrl-C, nohup a closed terminal.
        f"signal.signal(signal.{name}, signal.SIG_DFL)\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def info(path: str) -> None:\n"
        "    'Stops itself.'\n"
        "    try:\n"
        f"        os.kill(os.getpid(), signal.{name})\n"
        "    finally:\n"
        f"        os.kill(os.getpid(), signal.{name})\n"  # by whom the first did not seem to help
        "        print('all is written')\n"
        "cli.COMMANDS['info'] = info\n"
        "sys.argv[1:] = ['info', '--path', 'x']\n"
        "atexit.register(os.kill, os.getpid(), signal.SIGINT)\n"
        "cli.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 130
    assert "all is written" in done.stdout
    assert "stopped" in done.stderr
    assert "Traceback" not in done.stderr


HOSTILE = (
    "[bold red]evil[/bold red]",
    "[/nothing]",
    "\x1b[2J\x1b]0;title\x07",
    "a\rb\x9bc\u202ed",
    "$\\foo$ </script><b>",
)


@pytest.mark.parametrize("name", HOSTILE)
def test_names_are_printed_as_they_are_and_control_characters_spelled(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit), plain_errors():
        raise FileFormatError(f"{name}: broken")
    with pytest.raises(SystemExit):
        main(["info", str(tmp_path / name.replace("/", "_"))])
    table = Table(name, title=name)
    table.add_row(name)
    console = PlainConsole()
    console.print(table, name)
    told = capsys.readouterr().err
    spelled = name.encode("unicode_escape").decode().replace("\\\\", "\\")
    assert told.count(spelled) == (5 if "/" in name else 6)
    assert f"error: {spelled}: broken" in told
    assert not any(sign in told for sign in "\x1b\x07\r\x9b\u202e")


def test_a_path_goes_to_a_program_as_it_is(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    print_path(Path("a\x1b[31m.csv"))
    assert capsys.readouterr().out == "a\x1b[31m.csv\n"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    print_path(Path("a\x1b[31m.csv"))
    assert capsys.readouterr().out == "a\\x1b[31m.csv\n"


def test_hostile_names_pass_through_a_solve_and_its_report(dome_rig: BlendshapeRig, tmp_path: Path) -> None:
    rig = BlendshapeRig(dome_rig.neutral, dome_rig.deltas, ["jawOpen", *HOSTILE[:3]])
    rig_path, take, sites = tmp_path / "rig.glb", tmp_path / "take.c3d", place_markers(dome_rig, 12)
    save_rig(rig, rig_path)
    sites.save(tmp_path / "sites.json")
    save_take(record(rig, sites, torch.rand(6, 4), torch.Generator().manual_seed(0)).take, take)
    image = from_figure(motion_figure("$\\foo$ \x1b[31m"))
    assert image.shape[0] == 3
    words = ["solve", rig_path, take, "--attachment", tmp_path / "sites.json", "--frame-by-frame", "--quiet"]
    main([str(word) for word in (*words, "--out", tmp_path / "[red]w.csv")])
    assert (tmp_path / "[red]w.csv").is_file()


def motion_figure(name: str) -> Figure:
    figure = Figure(figsize=(2, 2))
    axes = figure.subplots()
    axes.plot([1, 2], [3, 40], label=name)
    axes.set(title=name, xlabel=name, yscale="log")
    axes.set_xticks([1, 2], [name, name])
    axes.legend()
    return figure


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "--sparsity", "1e300"),
        ("solve", "--sparsity", "nan"),
        ("solve", "--ridge", "-1"),
        ("solve", "--stream", "udp://a..b:1"),
        ("enhance", "--model", "head", "--detail", "nan"),
        ("render", "--height", "0"),
        ("render", "--height", "1000000000"),
        ("render", "--height", "20", "--yaw", "nan"),
        ("demo", "--seed", str(10**23)),
        ("view", "--port", "99999"),
        ("view", "--port", "-1"),
        ("pick", "--port", "65536"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(
    stage: Path, tmp_path: Path, words: tuple[str, ...], messages_of: Callable[..., str]
) -> None:
    if words[0] in ("view", "pick"):
        pytest.importorskip("viser")
    given = {
        "solve": (stage / "rig.glb", stage / "take.c3d", "--attachment", stage / "attachment.json"),
        "demo": (),
        "pick": (stage / "rig.glb", "--out", tmp_path / "out.json"),
    }.get(words[0], (stage / "rig.glb",))
    file = {"demo": "out", "solve": "out.csv"}.get(words[0], "out.png")
    out = () if words[0] in ("view", "pick") else ("--out", tmp_path / file)
    told = messages_of(words[0], *given, *words[1:], *out, status=2)
    assert words[-2].lstrip("-") in told
    assert "found" in told
    assert "expected" in told or "not known" in told


def test_view_plays_takes_with_gaps_and_animated_rigs(
    stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser")
    shown = []

    def serve(page: Any, line: str) -> None:
        shown.append((page.editor.weights[:, page.rig.names.index("jawOpen")].tolist(), line))
        page.stop()

    monkeypatch.setattr(sys.modules["torchface.cli.view"], "serve_page", serve)
    (tmp_path / "gap.csv").write_text("frame,time,jawOpen\n0,0,0.25\n1,0.1,\n2,0.2,0.75\n")
    rig, out = str(stage / "rig.glb"), str(tmp_path / "out.csv")
    main(["view", rig, str(tmp_path / "gap.csv"), "--port", "0", "--out", out])
    animated = str(tmp_path / "animated.glb")
    main(["retarget", str(tmp_path / "gap.csv"), "--to", rig, "--out", out, "--animation", animated])
    main(["view", animated, animated, "--port", "0", "--out", out])
    assert [weights for weights, _ in shown] == [pytest.approx([0.25, 0.5, 0.75])] * 2
    assert [line[:29] for _, line in shown] == ["1 frames without a face take ", ""]


def test_a_head_that_a_page_cannot_show_for_its_size_is_said(
    dome_rig: BlendshapeRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("viser")
    for name in ("view", "pick"):
        monkeypatch.setattr(sys.modules[f"torchface.cli.{name}"], "serve_page", lambda page, line="": page.stop())
    small = BlendshapeRig(
        dome_rig.neutral.with_vertices(dome_rig.vertices / 1e3), dome_rig.deltas / 1e3, dome_rig.names
    )
    rig, metres, head = tmp_path / "rig.glb", tmp_path / "metres.obj", tmp_path / "head.obj"
    save_rig(small, rig)
    save_mesh(small.neutral, metres)
    save_mesh(dome_rig.neutral, head)
    for words, name in (("view", rig), rig), (("pick", head, metres), f"{metres} (--scan-unit)"):
        main([*map(str, words), "--port", "0"])
        said = "".join(capsys.readouterr().err.split())
        assert said.count("warning:") == 1
        assert f"warning:{name}:0.".replace(" ", "") in said


def test_picks_that_could_not_be_saved_are_not_begun(
    stage: Path, monkeypatch: pytest.MonkeyPatch, messages_of: Callable[..., str]
) -> None:
    pytest.importorskip("viser")
    monkeypatch.setattr(sys.modules["torchface.cli.pick"], "serve_page", lambda page: page.stop())
    said = messages_of("pick", stage / "rig.glb", "--out", stage / "file", "--port", "0", status=2)
    assert f"{stage / 'file'}: cannot be written" in said


@pytest.mark.parametrize("words", ["export --help", "--version", "--help"])
def test_output_that_nobody_reads_ends_quietly(words: str) -> None:
    code = "from torchface.cli import main; import sys; sys.stdin.read(); main()"
    run = subprocess.Popen([sys.executable, "-c", code, *words.split()], stdin=-1, stdout=-1, stderr=-1, text=True)
    run.stdout.close()
    run.stdout = None
    assert run.communicate("")[1] == ""
    assert run.returncode == 141


def test_a_seed_is_checked_before_libraries_are_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, messages_of: Callable[..., str]
) -> None:
    monkeypatch.setitem(sys.modules, "torchface.workflows.demo.run_demo", None)  # whose import fails
    told = messages_of("demo", "--seed", "-1", "--out", tmp_path / "out", status=2)
    assert "--seed: found -1, expected a whole number from 0 to 4294967295" in told

"""Steps of commands on a terminal and in a log."""

from functools import partial
from io import StringIO

import pytest
from rich.console import Console

from torchface.cli import progress_bars


def test_an_error_leaves_no_spinner_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = StringIO()
    monkeypatch.setattr(progress_bars, "console", Console(file=screen, force_terminal=True, width=60))

    def breaks() -> None:
        with progress_bars.progress_bars() as step:
            step("done with")
            step("at this it breaks")
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        breaks()
    last = screen.getvalue().split("\x1b[2K")[-1]
    assert "done with" in last
    assert "at this" not in last


def test_counted_steps_show_a_bar_and_a_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, screen = [0.0], StringIO()
    monkeypatch.setattr(progress_bars, "console", Console(file=screen, force_terminal=True, width=100))
    monkeypatch.setattr(progress_bars, "Bars", partial(progress_bars.Bars, get_time=lambda: clock[0]))
    with progress_bars.progress_bars() as step:
        step("solving", 100, 300)  # a hundred are from an earlier run
        clock[0] = 4.0
        step("solving", 300, 300)
        step("writing")
    last = screen.getvalue().split("\x1b[2K")[-1]
    assert "300/300 50 a second" in last
    assert "━" in last.splitlines()[0]
    assert "━" not in last.splitlines()[1]


def test_a_log_gets_a_line_a_step_and_none_when_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, log = [0.0], StringIO()
    monkeypatch.setattr(progress_bars, "console", Console(file=log, width=100))
    monkeypatch.setattr(progress_bars.time, "monotonic", lambda: clock[0])
    for quiet in (True, False):
        with progress_bars.progress_bars(quiet) as step:
            for done in range(0, 100, 5):
                clock[0] = 2.0 * done
                step("registering scans", done, 100)
            step("writing")
        if quiet:
            assert log.getvalue() == ""
    lines = log.getvalue().splitlines()
    assert lines[0] == "registering scans"
    assert lines[1] == "registering scans: 15 of 100, 30.0 a minute"
    assert lines[-1] == "writing"
    assert len(lines) == 2 + 6

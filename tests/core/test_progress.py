from __future__ import annotations

import io

import pytest
from rich.console import Console

from mtpcr_geo.core.progress import NoProgress, RichProgress


@pytest.mark.parametrize("terminal", [False, True])
def test_bars_only_on_a_terminal(terminal):
    text = io.StringIO()
    bars = RichProgress(Console(file=text, force_terminal=terminal, width=80))
    with bars as progress, progress.task("reading", 10) as advance:
        advance(4)
        with progress.task("and something of unknown length") as step:
            step(1)
    assert ("reading" in text.getvalue()) == terminal
    assert ("40%" in text.getvalue()) == terminal


def test_no_progress_takes_the_same_calls():
    with NoProgress().task("reading", 10) as advance:
        advance(4)


def test_a_failed_task_leaves_no_bar():
    progress = RichProgress(Console(file=io.StringIO()))
    with pytest.raises(ValueError, match="broken"), progress.task("reading"):
        raise ValueError("broken")
    assert progress._bars.tasks == []

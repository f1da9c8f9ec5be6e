"""What the verbs of the command share: progress bars, and how a verdict ends."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mtpcr_geo.cli import options
from mtpcr_geo.cli.parameters import switch
from mtpcr_geo.core.errors import EXIT_DOUBTFUL, EXIT_REFUSED, one_line
from mtpcr_geo.core.wording import visible

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.core.types import Verdict

Quiet = Annotated[bool, switch(options.Quiet)]
Overwrite = Annotated[bool, switch(options.Overwrite)]

EXIT_BY_VERDICT = {"accepted": 0, "doubtful": EXIT_DOUBTFUL, "refused": EXIT_REFUSED}


@contextmanager
def progress_bars(quiet: bool, always: bool = False) -> Iterator[Progress]:
    """Show progress on standard error: where that is a terminal, or always."""
    from mtpcr_geo.core.progress import NoProgress, RichProgress

    if quiet or not (always or sys.stderr.isatty()):
        yield NoProgress()
        return
    from rich.console import Console

    with RichProgress(Console(stderr=True, force_terminal=True if always else None)) as bars:
        yield bars


def say(text: str) -> None:
    """Print lines on standard output, with what a terminal would obey written as escapes."""
    typer.echo(visible(text))


def note(text: str) -> None:
    """Print a remark in one line on standard error."""
    typer.echo(one_line(f"mtpcr-geo: {text}"), err=True)


def warn(text: str) -> None:
    """Print a warning in one line on standard error."""
    typer.echo(one_line(f"mtpcr-geo: warning: {text}"), err=True)


def end_with(verdict: Verdict | None, *, quiet: bool) -> typer.Exit:
    """Return the exit that a verdict calls for; with `quiet`, one line says why it is not accepted."""
    if verdict is None:
        return typer.Exit(0)
    if quiet and verdict.name != "accepted":
        reason = f": {verdict.reasons[0]}" if verdict.reasons else ""
        typer.echo(one_line(f"mtpcr-geo: {verdict.name}{reason}"), err=True)
    return typer.Exit(EXIT_BY_VERDICT[verdict.name])


def json_text(value: Any) -> str:
    """Return a value as indented strict JSON: arrays as lists, paths as text, what is not finite as null."""
    from mtpcr_geo.export.run_json import plain

    return json.dumps(plain(value), indent=2, allow_nan=False)

"""What the verbs of the command share: options, and progress bars."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress

Verbose = Annotated[
    bool, typer.Option("--verbose", "-v", help="Say what every stage did and how long it took.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the run as JSON on standard output.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that are already there.")]


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

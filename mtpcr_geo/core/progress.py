"""Progress of long work: bars on a terminal, or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from mtpcr_geo.core.wording import visible

if TYPE_CHECKING:
    from rich.console import Console

Advance = Callable[[int], None]


class Progress(Protocol):
    """Where long work reports how far it is."""

    def task(self, what: str, total: int | None = None) -> AbstractContextManager[Any]:
        """Open a task; the context gives a callable `advance(n)`."""


class NoProgress:
    """Reports nothing."""

    @contextmanager
    def task(self, what: str, total: int | None = None) -> Iterator[Advance]:
        """Open a task that is not shown."""
        yield lambda count: None


class RichProgress:
    """Bars on a console, gone when the work is done; nothing where the console is no terminal.

    Use as a context manager around the whole run.
    """

    def __init__(self, console: Console) -> None:
        from rich import progress

        self._bars = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.TaskProgressColumn(),
            progress.TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    @contextmanager
    def task(self, what: str, total: int | None = None) -> Iterator[Advance]:
        """Open a bar, or a pulsing one where the total is not known."""
        bar = self._bars.add_task(visible(what), total=total)
        try:
            yield lambda count: self._bars.advance(bar, count)
        finally:
            self._bars.remove_task(bar)

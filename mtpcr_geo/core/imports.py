"""Importing modules that will be needed while other work is done."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from mtpcr_geo.core.system import usable_cores


def import_ahead(names: Iterable[str]) -> None:
    """Import modules in their order by another thread, and return at once.

    Whoever imports one of them meanwhile waits until it is there. One that cannot be imported is left to
    that place, where the reason is told. With one core to use nothing is done.

    Args:
        names: of the modules, those that are needed first first.

    """
    missing = [name for name in dict.fromkeys(names) if name not in sys.modules]
    if not missing or usable_cores() == 1:
        return
    worker = ThreadPoolExecutor(1, thread_name_prefix="imports")
    for name in missing:
        # the result is not asked for, and an exception is part of it
        worker.submit(importlib.import_module, name)
    worker.shutdown(wait=False)


def search_path() -> list[str]:
    """Return where this process looks for modules, for one that it starts; no folders that are packages.

    While another thread imports OpenCV its own folder stands before the standard library, and holds a
    ``typing``: a process that starts then would take that for Python's.
    """
    return [path for path in sys.path if not os.path.isfile(os.path.join(path, "__init__.py"))]


@contextmanager
def without(name: str) -> Iterator[None]:
    """Let a package be found missing meanwhile, by whatever imports it where it can do without.

    One that is imported already stays.
    """
    if name in sys.modules:
        yield
        return
    sys.modules[name] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        del sys.modules[name]

"""Making the next item of a stream while the last one is worked on."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from mtpcr_geo.core.system import usable_cores

Item = TypeVar("Item")


def ahead(items: Iterator[Item]) -> Generator[Item, None, None]:
    """Yield the same items in the same order, each made by another thread while the one before is in use.

    One item is made ahead at most, so that no more than two are held. Of a stream of one item, and where
    one core may be used, nothing is made by another thread. The stream is closed with this one.

    Raises:
        Exception: what the stream raises, where its item would have come.

    """
    end: Any = object()
    try:
        item = next(items, end)
        if item is end:
            return
        yield item
        if usable_cores() == 1:
            yield from items
            return
        with ThreadPoolExecutor(1, thread_name_prefix="ahead") as worker:
            coming = worker.submit(next, items, end)
            while (item := coming.result()) is not end:
                coming = worker.submit(next, items, end)
                yield item
    finally:
        if isinstance(items, Generator):
            items.close()

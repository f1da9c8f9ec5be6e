"""Where work is done: in this process, on worker processes of this machine, or on a cluster; all by Dask."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from traceback import extract_tb
from typing import Any, Generic, TypeVar

from mtpcr_geo.core.errors import InputError, MissingPartError, MtpcrError
from mtpcr_geo.core.system import cores, usable_cores
from mtpcr_geo.survey.options import EngineOptions

Item = TypeVar("Item")
Made = TypeVar("Made")

CONNECT_S = 30.0
SAME_PATHS = "all workers must see the same folders, under the same paths, as this machine"


@dataclass(frozen=True)
class Outcome(Generic[Item, Made]):
    """What became of one piece of work.

    Attributes:
        item: what it was.
        made: its result; None where it failed.
        error: why it failed, in a line; None where it did not.

    """

    item: Item
    made: Made | None
    error: str | None = None


class Engine:
    """Does pieces of work in this process, one after the other."""

    def run(
        self, work: Callable[[Item], Made], items: Sequence[Item], retries: int = 3
    ) -> Iterator[Outcome[Item, Made]]:
        """Do each piece of work; yield what became of each, in the order in which they end.

        An error ends its piece alone, be it one that a user can cause or a defect.

        Args:
            work: a function of a module.
            items: what it is called with.
            retries: how often a piece is tried again whose process died.

        """
        for item in items:
            yield Outcome(item, *_tried(work, item))


class DaskEngine(Engine):
    """Does pieces of work on the workers of a Dask client.

    Args:
        client: of the cluster.
        cores_each: processor cores that a piece of work may use; 0 for all of its machine's.

    """

    def __init__(self, client: Any, cores_each: int = 0) -> None:
        self.client = client
        self.cores_each = cores_each

    def run(
        self, work: Callable[[Item], Made], items: Sequence[Item], retries: int = 3
    ) -> Iterator[Outcome[Item, Made]]:
        """Do each piece of work on some worker; see `Engine.run`."""
        from distributed import as_completed

        futures = {
            self.client.submit(_tried, work, item, self.cores_each, pure=False, retries=retries): item
            for item in items
        }
        for future in as_completed(list(futures), loop=self.client.loop):
            item = futures.pop(future)
            failure = future.exception() if future.status != "finished" else None
            if failure is None:
                yield Outcome(item, *future.result())
            else:
                yield Outcome(item, None, _why(failure))
            future.release()


def _tried(work: Callable[[Any], Any], item: Any, most: int = 0) -> tuple[Any, str | None]:
    try:
        with cores(most):
            return work(item), None
    except MtpcrError as error:
        return None, str(error)
    except Exception as error:  # noqa: BLE001 - the other pieces are done whatever fails in this one
        return None, _defect(error)


def _defect(error: BaseException) -> str:
    """Say in a line what went wrong in the program, and in which line of it."""
    frames = extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"a defect: {type(error).__name__}: {error}{where}"


def _why(failure: BaseException) -> str:
    from distributed import KilledWorker

    if isinstance(failure, KilledWorker):
        return "its worker process died each time it was tried; is there memory enough?"
    return _defect(failure)


def has_dask() -> bool:
    """Return whether Dask's distributed scheduler is installed."""
    from importlib.util import find_spec

    return find_spec("distributed") is not None


@contextmanager
def engine_of(options: EngineOptions, most: int) -> Iterator[Engine]:
    """Start what does the work, and stop it at the end.

    Args:
        options: where the work is to be done.
        most: pieces of work there are at most: more workers are not started.

    Raises:
        MissingPartError: if Dask is wanted and not installed.
        InputError: if a scheduler does not answer.

    """
    wanted = options.workers or (usable_cores() if has_dask() else 1)
    wanted = max(1, min(wanted, most))
    if options.scheduler is None and wanted == 1:
        yield Engine()
        return
    if not has_dask():
        raise MissingPartError(
            'more than one worker, and --scheduler, need Dask: pip install "mtpcr-geo[cluster]"; --workers 1 '
            "goes without"
        )
    import logging

    import dask
    from distributed import Client, LocalCluster

    # a piece of work is tried again as often as its caller says, and no more rarely
    with dask.config.set({"distributed.scheduler.allowed-failures": 10}):
        if options.scheduler is not None:
            try:
                client = Client(options.scheduler, timeout=CONNECT_S, set_as_default=False)
            except (OSError, ValueError) as error:
                raise InputError(
                    f"the scheduler {options.scheduler} does not answer ({error}); is its address right?"
                ) from error
            with client:
                yield DaskEngine(client)
            return
        with (
            LocalCluster(
                n_workers=wanted,
                threads_per_worker=1,
                processes=True,
                # any free port of this machine alone: the usual one may be another run's
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):
            # workers of one machine share its cores: each taking all of them only gets in the others' way
            yield DaskEngine(client, max(1, usable_cores() // wanted))

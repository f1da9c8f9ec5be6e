"""What an earlier run of a job left in its folder, and how it is taken away."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from mtpcr_geo.core.errors import InputError, MtpcrError
from mtpcr_geo.core.paths import link_among, read_whole
from mtpcr_geo.io.formats import files_at
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline.options import OUTPUT_NAMES, RegisterOptions
from mtpcr_geo.pipeline.stages.steps import further_files, writers_for

_PARTS = "registered"
_EACH = "mtpcr.write_each"


def remove_earlier(folder: Path, inputs: Sequence[Path]) -> None:
    """Remove the result that an earlier registration left in the folder of a job.

    Only what a registration writes is removed, by its name: other files, links, and what the job reads stay.
    Folders go where nothing is left in them.

    Args:
        folder: of the job.
        inputs: what the job reads, as it names it.

    Raises:
        OutputError: if something cannot be removed.

    """
    folders = (folder / OUTPUT_NAMES["bev"].parent, folder / _PARTS)
    if not folder.is_dir() or link_among((folder, *folders)) is not None:
        return
    with OutputSet(overwrite=True) as outputs:
        for path in inputs:
            with suppress(MtpcrError):
                outputs.keep(files_at(path))
        outputs.replace(list(_left_in(folder)))
        outputs.commit()
    for emptied in (*folders, folder):
        if emptied.is_dir() and not any(emptied.iterdir()):
            # what is put there just now stays
            with suppress(OSError):
                emptied.rmdir()


def _left_in(folder: Path) -> Iterator[Path]:
    """Yield the files that a registration may have left in a folder."""
    for stage in writers_for(None, folder, RegisterOptions()):
        yield from stage.writes()
    yield from further_files(folder)
    # a source of many files has as many moved ones, which the run names
    try:
        pipeline = json.loads(read_whole(folder / OUTPUT_NAMES["run"]))["pipeline"]
        names = [str(name) for stage in pipeline if stage["type"] == _EACH for name in stage["names"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError, InputError):
        return
    yield from (folder / _PARTS / name for name in names if Path(name).name == name)

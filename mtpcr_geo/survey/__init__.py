"""Surveys of many tiles: a mosaic of height rasters to register against, and many registrations at once.

`build.build_survey` makes the mosaic, `register.register_in_survey` finds a scan in it and registers it to
the points of the tiles there, `batch.run_batch` registers many sources. Building and batches run on Dask
where more than one process is wanted; nothing of it is imported before.
"""

from __future__ import annotations

import os

SURVEY = "survey.json"


def is_survey(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is the folder of a survey."""
    return os.path.isfile(os.path.join(path, SURVEY))

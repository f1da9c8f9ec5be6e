"""Options of building a survey and of batches, declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from mtpcr_geo.pipeline.options import Overwrite
from mtpcr_geo.pipeline.shown import INPUTS, OUTPUT, RASTERS, RUN, Shown

Workers = Annotated[
    int | None,
    Field(
        ge=1,
        le=1024,
        description="processes on this machine; 1 works in this one, without Dask; if not given as many as "
        "cores, or 1 where Dask is not installed",
    ),
    Shown(RUN),
]
Scheduler = Annotated[
    str | None,
    Field(
        min_length=1,
        description="address of a running Dask scheduler whose workers see the same files, such as "
        "tcp://10.0.0.1:8786, instead of processes on this machine",
    ),
    Shown(RUN, metavar="ADDRESS"),
]


class EngineOptions(BaseModel):
    """Where the work is done."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    workers: Workers = None
    scheduler: Scheduler = None


class BuildOptions(EngineOptions):
    """Options of building a survey."""

    cell: Annotated[
        float | None,
        Field(
            gt=0,
            le=20,
            allow_inf_nan=False,
            description="edge of the finest cells, metres; from the density of the tiles if not given, 1 m "
            "at the finest; an existing survey keeps its own",
        ),
        Shown(RASTERS),
    ] = None
    crs: Annotated[
        str | None,
        Field(description="CRS of all tiles, instead of what their files state, such as EPSG:28992"),
        Shown(INPUTS),
    ] = None
    prune: Annotated[
        bool, Field(description="leave out tiles of an existing survey that are not named now"), Shown(INPUTS)
    ] = False


class BatchOptions(EngineOptions):
    """Options of a batch."""

    retries: Annotated[
        int,
        Field(ge=0, le=100, description="how often a job is tried again whose worker process died"),
        Shown(RUN),
    ] = 3
    overwrite: Overwrite = False


Folder = Annotated[
    Path, Field(description="folder of the survey; made if it is not there"), Shown(OUTPUT, ("--out", "-o"))
]

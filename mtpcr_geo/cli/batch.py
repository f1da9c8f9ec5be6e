"""The verb ``batch``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated

from pydantic import Field

from mtpcr_geo.cli.options import Quiet
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import progress_bars, say, warn
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.wording import in_a_line
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.shown import INPUTS, OUTPUT, Shown
from mtpcr_geo.survey.options import BatchOptions

MOST_NAMED = 10


class BatchVerb(BatchOptions, RegisterOptions):
    """Options of ``batch``."""

    jobs: Annotated[
        Path,
        Field(
            description="table (CSV) with a row a job: source, target, name, and any option of register as a "
            "column; or a folder, pattern in quotes or @LIST of sources"
        ),
        Shown(INPUTS, argument=True),
    ]
    target: Annotated[
        Path | None,
        Field(description="target of the jobs that name none: a cloud, or the folder of a survey"),
        Shown(INPUTS),
    ] = None
    out: Annotated[
        Path,
        Field(description="folder of the batch; made if it is not there"),
        Shown(OUTPUT, ("--out", "-o")),
    ]
    recording: Annotated[
        bool, Field(description="write a recording of each job for the rerun viewer"), Shown(OUTPUT)
    ] = False
    quiet: Quiet = False


def run(options: BatchVerb) -> None:
    """Register many sources, each to its target or to a survey; write a table and a map of all.

    Every job has a folder of its own below OUT/jobs, as register leaves it. A batch that was stopped goes on
    with what is not done, by the same command. Exit code 0: every job came to a verdict, which the table has;
    5: some failed, and are named.

    Examples:
        mtpcr-geo batch jobs.csv -o batch --workers 2
        mtpcr-geo batch scans --target survey -o batch --source-crs local
        mtpcr-geo batch jobs.csv -o batch --scheduler tcp://10.0.0.1:8786

    """
    from mtpcr_geo.survey.batch import run_batch
    from mtpcr_geo.survey.jobs import jobs_of

    common = {
        name: getattr(options, name)
        for name in RegisterOptions.model_fields
        if name not in ("overwrite",) and name in options.model_fields_set
    }
    chosen = BatchOptions(**{name: getattr(options, name) for name in BatchOptions.model_fields})
    jobs = jobs_of(options.jobs, options.target, common)
    with progress_bars(options.quiet) as progress:
        batch = run_batch(jobs, options.out, chosen, progress)
    failed = [row for row in batch.rows if row.failed]
    if not options.quiet:
        counts = Counter(row.verdict for row in batch.rows)
        names = ("accepted", "doubtful", "refused", "failed")
        say(f"{batch.run} of {len(batch.rows)} jobs run now: " + ", ".join(f"{counts[n]} {n}" for n in names))
        say(f"  {in_a_line(batch.table)}\n  {in_a_line(batch.map)}")
    for row in failed[:MOST_NAMED]:
        warn(f"{row.name}: {row.reason}")
    if failed:
        raise InputError(
            f"{len(failed)} of {len(batch.rows)} jobs failed, see {batch.table}; the same command tries "
            "them again"
        )


command = command_of(BatchVerb, run)

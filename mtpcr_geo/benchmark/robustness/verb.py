"""What ``mtpcr-geo benchmark --robustness`` does: suites are run, and their rows summed up in files.

The folder holds ``robustness.csv`` (a line a run, appended as runs end), ``robustness.md`` (the sums of all
rows in it) and, where matplotlib is installed, ``discs.png``.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mtpcr_geo.benchmark.robustness.drive import run_cases
from mtpcr_geo.benchmark.robustness.results import read_rows, report, summarise
from mtpcr_geo.benchmark.robustness.runner import Row
from mtpcr_geo.benchmark.robustness.suites import SuiteOptions, cases
from mtpcr_geo.benchmark.tables import to_markdown
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.io.outputs import OutputSet

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress

ROWS, REPORT, DISCS = "robustness.csv", "robustness.md", "discs.png"


def run_suites(
    names: Sequence[str],
    options: SuiteOptions,
    out: Path,
    *,
    jobs: int = 1,
    time_limit_s: float = 600.0,
    progress: Progress | None = None,
) -> tuple[list[Row], str]:
    """Run suites, and write the sums of all rows of the folder.

    Args:
        names: of suites; see `suites.SUITES`.
        options: what they are made from.
        out: folder of the results; runs that it holds are kept.
        jobs, time_limit_s, progress: see `run_cases`.

    Returns:
        The rows of these suites, and their sums as a Markdown table.

    Raises:
        MtpcrError: for whatever a user can cause.

    """
    chosen = list(cases(names, options))
    if not chosen:
        raise OptionError(f"no case of {', '.join(names)} is named like {', '.join(options.only)}")
    path = Path(out) / ROWS
    rows = run_cases(chosen, path, jobs=jobs, time_limit_s=time_limit_s, progress=progress)
    whole = read_rows(path)
    with OutputSet(overwrite=True) as files:
        files.path(path.with_name(REPORT)).write_text(report(whole), "utf-8")
        discs = [row for row in whole if row["suite"] == "discs"]
        if discs and importlib.util.find_spec("matplotlib") is not None:
            from mtpcr_geo.benchmark.plots import draw_radii

            draw_radii(discs, files.path(path.with_name(DISCS)))
        files.commit()
    return rows, to_markdown(summarise(rows))

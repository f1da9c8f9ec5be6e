"""What the verb `benchmark` does: pairs from somewhere, the protocol, and its results as files.

The results' folder holds, besides what the protocol leaves (``runs.jsonl``): ``runs.csv`` (a
line a run), ``methods.csv`` and ``pairs.csv`` (sums), ``results.json`` (the same, with Tables I to IV),
``tables.md`` (for reading) and the plots as PNG where matplotlib is installed.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mtpcr_geo.benchmark import sources, tables
from mtpcr_geo.benchmark.pairs import pair_folders, read_facts
from mtpcr_geo.benchmark.protocol import Row, run_protocol
from mtpcr_geo.benchmark.simulator.kinds import KINDS
from mtpcr_geo.benchmark.worker import StartRange
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.io.outputs import OutputSet

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress

ABLATION = {"RES": "res", "FOCUS": "focus", "IE": "enhance"}
_STAND_IN_NOTE = (
    "Pairs named standin_ are simulated, with the paper's extents and overlaps; they are not GrAco"
)
_SHOWN = (
    "method", "runs", "answered", "success_5deg_2m_pct", "success_0.2deg_0.5m_pct", "wrong_answers",
    "false_accepts", "rotation_deg_median", "translation_m_median", "rotation_deg_mean",
    "translation_m_mean", "rmsd_m_mean", "time_s_median", "memory_mib_max",
)  # fmt: skip


@dataclass(frozen=True)
class PairSelection:
    """Which pairs to use; at least one of the first four.

    Attributes:
        data: folders of pairs.
        simulated: number of sites to simulate.
        standins: whether to simulate the paper's fourteen combinations.
        graco: folder of GrAco's bags.
        only: keep pairs whose names contain one of these.
        kinds, overlaps: of the simulated sites; all kinds if empty.

    """

    data: tuple[Path, ...] = ()
    simulated: int = 0
    standins: bool = False
    graco: Path | None = None
    only: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    overlaps: tuple[float, ...] = (0.18,)

    def folders(self, cache: Path, progress: Progress | None = None) -> list[Path]:
        """Return the pairs' folders, made in `cache` where they must be made.

        Raises:
            OptionError: if nothing is asked for.
            InputError: if something asked for is not there.

        """
        out: list[Path] = []
        for data in self.data:
            out += pair_folders(data, self.only)
        if self.simulated:
            kinds = self.kinds or KINDS
            made = sources.simulated(
                cache, self.simulated, kinds=kinds, overlaps=self.overlaps, progress=progress
            )
            out += [one for one in made if not self.only or any(word in one.name for word in self.only)]
        if self.standins:
            out += sources.stood_in(cache, self.only, progress=progress)
        if self.graco is not None:
            out += sources.from_graco(cache, self.graco, self.only, progress=progress)
        if not out:
            raise OptionError("nothing to run on; give --data, --simulated, --standins or --graco")
        return out


def run_benchmark(
    selection: PairSelection,
    methods: Sequence[str],
    out: Path,
    *,
    pairs: Path | None = None,
    starts: int = 10,
    ranges: StartRange | None = None,
    jobs: int = 1,
    time_limit_s: float = 600.0,
    progress: Progress | None = None,
) -> list[Row]:
    """Run the protocol and write its results; what an earlier call has run is kept.

    Args:
        selection: which pairs.
        methods: names with options, see `mtpcr_geo.benchmark.methods`.
        out: folder of the results.
        pairs: folder for pairs that must be made; ``pairs`` in `out` if not given.
        starts, ranges, jobs, time_limit_s, progress: see `run_protocol`.

    Raises:
        MtpcrError: for whatever a user can cause.

    """
    if len(set(methods)) < len(methods):
        raise OptionError("a method is named twice")
    folders = selection.folders(pairs or Path(out) / "pairs", progress)
    rows = run_protocol(
        folders,
        methods,
        out,
        starts=starts,
        ranges=ranges,
        jobs=jobs,
        time_limit_s=time_limit_s,
        progress=progress,
    )
    write_results(rows, Path(out), extents_of(folders))
    return rows


def write_results(rows: Sequence[Row], out: Path, extents: Mapping[str, Sequence[float]]) -> list[Path]:
    """Write tables and plots; older ones are replaced.

    Args:
        rows: runs.
        out: folder.
        extents: of each pair's two clouds together, metres (x, y, z), where known.

    """
    made = {
        "table_1": tables.table_1(extents, rows),
        "table_2": tables.table_2(rows),
        "table_3": tables.table_3(rows),
        "table_3_strict": tables.table_3(rows, tables.STRICT),
        "table_4": tables.table_4(rows, ABLATION),
    }
    methods, pairs = tables.by_method(rows), tables.by_pair(rows)
    with OutputSet(overwrite=True) as files:
        files.path(out / "runs.csv").write_text(_csv([_flat(row) for row in rows]), "utf-8")
        files.path(out / "methods.csv").write_text(_csv(methods), "utf-8")
        files.path(out / "pairs.csv").write_text(_csv(pairs), "utf-8")
        whole = {"frame": tables.FRAME_NOTE, "methods": methods, "pairs": pairs, **made}
        files.path(out / "results.json").write_text(json.dumps(whole, indent=1) + "\n", "utf-8")
        files.path(out / "tables.md").write_text(_report(rows, made), "utf-8")
        if importlib.util.find_spec("matplotlib") is not None and rows:
            from mtpcr_geo.benchmark.plots import PLOTS, draw_all

            note = _STAND_IN_NOTE if any("standin_" in row["pair"] for row in rows) else ""
            draw_all(rows, {name: files.path(out / f"{name}.png") for name in PLOTS}, note)
        return files.commit()


def shown(rows: Sequence[Row]) -> str:
    """Return the sums of each method as a Markdown table."""
    return tables.to_markdown([{key: line[key] for key in _SHOWN} for line in tables.by_method(rows)])


def numbers_of(text: str) -> tuple[float, ...]:
    """Read numbers separated by blanks or commas.

    Raises:
        OptionError: if something else is among them.

    """
    try:
        return tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError as error:
        raise OptionError(f"{text!r} is no list of numbers") from error


def extents_of(folders: Sequence[Path]) -> dict[str, list[float]]:
    """Return the extents that pairs' descriptions tell: metres in x, y, z, by name."""
    out = {}
    for folder in folders:
        facts = read_facts(folder)
        for key in ("simulation", "benchmark"):
            extent = facts.get(key, {}).get("extent_m")
            if isinstance(extent, list):
                out[folder.name] = extent
    return out


def _report(rows: Sequence[Row], made: Mapping[str, list[dict[str, Any]]]) -> str:
    titles = {
        "table_1": "Table I: extent (m) and overlap (%)",
        "table_2": "Table II: mean errors",
        "table_3": "Table III: success rate, % (5 degrees, 2 m)",
        "table_3_strict": "Success rate at strict thresholds, % (0.2 degrees, 0.5 m)",
        "table_4": "Table IV: parts of the paper's method on and off",
    }
    text = ["# Benchmark\n", tables.FRAME_NOTE + ".\n", shown(rows)]
    if any("standin_" in row["pair"] for row in rows):
        text.append(_STAND_IN_NOTE + ".\n")
    text.append(
        'Lines marked "paper, GrAco" are its own figures on other data; nothing of them was run here.\n'
    )
    for key, title in titles.items():
        if made[key]:
            text += [f"## {title}\n", tables.to_markdown(made[key])]
    return "\n".join(text)


def _flat(row: Row) -> dict[str, Any]:
    """Return a run as one line: with its successes, without the matrix and the details."""
    line = {key: value for key, value in row.items() if key not in ("T_target_source", "details")}
    line |= {tables.label(limits): tables.success(row, limits) for limits in tables.THRESHOLDS}
    return line | {"false_accept": tables.false_accept(row)}


def _csv(lines: Sequence[Mapping[str, Any]]) -> str:
    columns = list(dict.fromkeys(key for line in lines for key in line))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()

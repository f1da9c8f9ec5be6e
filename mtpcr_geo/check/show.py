"""A check on the terminal: a table of facts, and what was found."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from mtpcr_geo.check.pair import Relation, distance_text
from mtpcr_geo.core.wording import in_a_line

if TYPE_CHECKING:
    from rich.console import Console

    from mtpcr_geo.check.describe import CloudFacts
    from mtpcr_geo.check.preflight import CheckReport

_COLOUR = {"error": "bold red", "warning": "bold yellow", "note": "cyan"}
_UNKNOWN = "-"


def show(report: CheckReport, *, as_json: bool, quiet: bool) -> None:
    """Print a check on standard output: as JSON, as tables, or not at all."""
    if as_json:
        print(json_of(report))
    elif not quiet:
        from rich.console import Console

        print_report(Console(highlight=False), report)


def json_of(report: CheckReport) -> str:
    """Return a check as JSON."""
    from mtpcr_geo.export.run_json import plain

    whole = {
        "goes_on": report.goes_on,
        "exit_code": report.exit_code,
        "clouds": {role: asdict(facts) for role, facts in report.clouds.items()},
        "relation": None if report.relation is None else asdict(report.relation),
        "findings": [asdict(finding) for finding in report.findings],
    }
    return json.dumps(plain(whole), indent=2, allow_nan=False)


def print_report(console: Console, report: CheckReport) -> None:
    """Print the facts of each cloud side by side, their relation, and the findings with their fixes."""
    from rich.table import Table
    from rich.text import Text

    several = len(report.files) > 1
    if report.clouds:
        table = Table(box=None, pad_edge=True, padding=(0, 1))
        table.add_column("")
        for role in report.files:
            table.add_column(role if several else "", overflow="fold")
        columns = [
            _cells(report.clouds[role]) if role in report.clouds else defaultdict(lambda: _UNKNOWN, file=file)
            for role, file in report.files.items()
        ]
        for label in _cells(next(iter(report.clouds.values()))):
            table.add_row(label, *(Text(in_a_line(column[label])) for column in columns))
        console.print(table)
    if report.relation is not None:
        console.print(Text(in_a_line(f"  {relation_text(report.relation)}")), soft_wrap=True)
    for finding in report.findings:
        where = "" if finding.role == "both" or not several else f"{finding.role}: "
        line = Text(f"{finding.severity:>7} ", _COLOUR[finding.severity])
        console.print(line.append(in_a_line(f"{where}{finding.what}"), "default"), soft_wrap=True)
        if finding.fix:
            console.print(Text(in_a_line(f"        -> {finding.fix}"), "dim"), soft_wrap=True)
    if report.goes_on:
        console.print(Text("register would go on with this", "bold green"))
    else:
        console.print(Text(f"register would refuse this, with exit code {report.exit_code}", "bold red"))


def relation_text(relation: Relation) -> str:
    """Return how two clouds lie to each other, as one line."""
    if relation.name == "unknown":
        return f"whether they overlap is not known: {relation.why}"
    if relation.name == "apart":
        middles = " from middle to middle" if relation.by_middles else ""
        return f"by their CRSs they are {distance_text(relation.distance_m or 0.0)} apart{middles}"
    return (
        f"by their CRSs they overlap: {relation.overlap_m2:,.0f} m2, "
        f"{relation.source_share:.0%} of the source and {relation.target_share:.0%} of the target"
    )


def _cells(facts: CloudFacts) -> dict[str, str]:
    crs = facts.crs
    code = f" ({facts.crs_code})" if facts.crs_code else ""
    noise = f", {facts.noise_points:,} of them noise" if facts.noise_points else ""
    density, area = facts.density_per_m2, facts.area_m2
    epoch = f"{facts.epoch:g}" if facts.epoch is not None else None
    if epoch is None and facts.datum_epoch is not None:
        epoch = f"not stated (datum of {facts.datum_epoch:g})"
    return {
        "file": facts.file,
        "format": facts.format,
        "points": f"{facts.points:,}{noise}",
        "CRS": _UNKNOWN if crs is None else f"{crs}{code}",
        "CRS stated by": facts.crs_by or _UNKNOWN,
        "units": " / ".join(_both(facts.horizontal_unit, facts.vertical_unit)),
        "heights": facts.heights or _UNKNOWN,
        "epoch": epoch or _UNKNOWN,
        "density": _UNKNOWN if density is None else f"{density:.3g} per m2 on {area:,.0f} m2",
        "extent": _UNKNOWN if facts.extent_m is None else f"{_numbers(facts.extent_m, 1, ' x ')} m",
        "lowest": _numbers(facts.minimum, _decimals(facts), "  "),
        "highest": _numbers(facts.maximum, _decimals(facts), "  "),
        "scale": _triple(facts.scale),
        "offset": _triple(facts.offset),
    }


def _both(horizontal: str | None, vertical: str | None) -> list[str]:
    units = [unit for unit in (horizontal, vertical) if unit is not None]
    return units if len(set(units)) > 1 else units[:1] or [_UNKNOWN]


def _decimals(facts: CloudFacts) -> int:
    return 7 if facts.horizontal_unit and facts.horizontal_unit.startswith("degree") else 2


def _numbers(values: Sequence[float], decimals: int, between: str) -> str:
    return between.join(f"{value:.{decimals}f}" for value in values)


def _triple(values: Sequence[float]) -> str:
    if not values:
        return _UNKNOWN
    same = len(set(values)) == 1
    return f"{values[0] + 0.0:g}" if same else "  ".join(f"{value + 0.0:.10g}" for value in values)

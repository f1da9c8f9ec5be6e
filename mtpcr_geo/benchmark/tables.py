"""What runs come to: sums by method and pair, and the paper's Tables I to IV remade from them.

Pure functions on the rows of ``runs.jsonl``. How things are counted:

answered
    a transform was given, and the method itself did not refuse it.
success
    answered, with rotation and translation errors below the thresholds. The paper's rate (SRR) takes
    5 degrees and 2 m.
false accept
    the verdict is "accepted" and the run is no success at 5 degrees and 2 m. Only methods that give a
    verdict can have one.
wrong answer
    answered and no success at 5 degrees and 2 m, whatever the verdict.
errors
    means and medians over the runs that gave a transform, refused or not, as the paper averages over all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mtpcr_geo.benchmark import published
from mtpcr_geo.benchmark.methods import options_of

Row = Mapping[str, Any]
Thresholds = Sequence[tuple[float, float]]

LENIENT = (5.0, 2.0)
STRICT = (0.2, 0.5)
THRESHOLDS: Thresholds = (LENIENT, STRICT)
ERRORS = ("rotation_deg", "translation_m", "plan_m", "height_m", "rmsd_m", "rms_m")
VERDICTS = ("accepted", "doubtful", "refused", "unjudged")
FRAME_NOTE = (
    "e_t in a frame whose origin is the middle of the target's bounds; RMSD is the mean distance, as the "
    "paper defines it"
)


def answered(row: Row) -> bool:
    """Return whether a run gave a transform that its method stands by."""
    return "rotation_deg" in row and row["verdict"] != "refused"


def success(row: Row, thresholds: tuple[float, float] = LENIENT) -> bool:
    """Return whether a run is a success: degrees and metres below the thresholds, and not refused."""
    return answered(row) and row["rotation_deg"] < thresholds[0] and row["translation_m"] < thresholds[1]


def false_accept(row: Row) -> bool:
    """Return whether a method accepted a wrong answer."""
    return bool(row["verdict"] == "accepted" and not success(row))


def label(thresholds: tuple[float, float]) -> str:
    """Name a success rate, such as ``success_5deg_2m``."""
    return f"success_{thresholds[0]:g}deg_{thresholds[1]:g}m"


def summarise(rows: Sequence[Row], thresholds: Thresholds = THRESHOLDS) -> dict[str, Any]:
    """Sum up runs: counts, success rates in percent, errors, time and memory."""
    n = len(rows)
    out: dict[str, Any] = {"runs": n, "answered": sum(map(answered, rows))}
    for limits in thresholds:
        right = sum(success(row, limits) for row in rows)
        out[label(limits) + "_pct"] = 100.0 * right / n if n else None
    out["wrong_answers"] = sum(answered(row) and not success(row) for row in rows)
    out["false_accepts"] = sum(map(false_accept, rows))
    out |= {name: sum(row["verdict"] == name for row in rows) for name in VERDICTS}
    for name in ERRORS:
        found = np.array([row[name] for row in rows if name in row], np.float64)
        if name == "height_m":
            found, name = np.abs(found), "height_abs_m"
        out[f"{name}_mean"] = float(found.mean()) if found.size else None
        out[f"{name}_median"] = float(np.median(found)) if found.size else None
    for name in ("time_s", "memory_mib"):
        known = np.array([row[name] for row in rows if row.get(name) is not None], np.float64)
        out[f"{name}_median"] = float(np.median(known)) if known.size else None
        out[f"{name}_max"] = float(known.max()) if known.size else None
    for name in ("overlap_source", "overlap_target"):
        shares = [row[name] for row in rows]
        out[name] = float(np.mean(shares)) if shares else None
    return out


def grouped(rows: Iterable[Row], *keys: str) -> dict[tuple[Any, ...], list[Row]]:
    """Sort runs by the values of some keys, in the order they come."""
    out: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        out.setdefault(tuple(row[key] for key in keys), []).append(row)
    return out


def by_method(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Sum up each method over everything."""
    return [{"method": m} | summarise(own) for (m,), own in grouped(rows, "method").items()]


def by_pair(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Sum up each method on each pair."""
    return [
        {"method": m, "group": g, "pair": p} | summarise(own)
        for (m, g, p), own in grouped(rows, "method", "group", "pair").items()
    ]


def table_1(extents: Mapping[str, Sequence[float]], rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Remake Table I: extent and overlap of each pair, beside the paper's where it gives them.

    Args:
        extents: extent of both clouds together, metres (x, y, z), by pair.
        rows: any runs of the pairs, for the overlaps.

    """
    out = []
    for (pair,), own in grouped(rows, "pair").items():
        line: dict[str, Any] = {"pair": pair}
        if pair in extents:
            line |= dict(zip(("dx_m", "dy_m", "dz_m"), extents[pair], strict=True))
        line["overlap_source_pct"] = 100 * own[0]["overlap_source"]
        line["overlap_target_pct"] = 100 * own[0]["overlap_target"]
        paper = published.TABLE_I.get(combination_of(pair))
        if paper is not None:
            line |= {f"paper_{key}": value for key, value in paper._asdict().items()}
        out.append(line)
    return out


def table_2(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Remake Table II: mean errors by method and pair, the paper's methods below."""
    rows = list(rows)
    names = {"e_r_deg": "rotation_deg", "e_t_m": "translation_m", "rmsd_m": "rmsd_m"}
    pairs = [pair for (pair,) in grouped(rows, "pair")]
    out: list[dict[str, Any]] = []
    for (method,), own in grouped(rows, "method").items():
        cells = {pair: summarise(runs) for (pair,), runs in grouped(own, "pair").items()}
        for metric, key in names.items():
            line: dict[str, Any] = {"figures": "measured here", "method": method, "metric": metric}
            out.append(line | {pair: cells[pair][f"{key}_mean"] if pair in cells else None for pair in pairs})
    at = {pair: _place(pair) for pair in pairs}
    if any(place is not None for place in at.values()):
        for method, errors in published.TABLE_II.items():
            for metric in published.METRICS:
                values = {
                    pair: None if place is None else errors[metric][place] for pair, place in at.items()
                }
                out.append({"figures": _whose(method), "method": method, "metric": metric} | values)
    return out


def table_3(rows: Iterable[Row], thresholds: tuple[float, float] = LENIENT) -> list[dict[str, Any]]:
    """Remake Table III: success rates in percent by method and group, the paper's methods below."""
    rows = list(rows)
    groups = [group for (group,) in grouped(rows, "group")]
    out: list[dict[str, Any]] = []
    for (method,), own in grouped(rows, "method").items():
        line: dict[str, Any] = {"figures": "measured here", "method": method}
        parts = {group: runs for (group,), runs in grouped(own, "group").items()}
        for group in groups:
            found = parts.get(group)
            line[group] = (
                None if found is None else 100 * float(np.mean([success(r, thresholds) for r in found]))
            )
        out.append(line)
    if thresholds == LENIENT and any(group in published.GROUPS for group in groups):
        for method, rates in published.TABLE_III.items():
            theirs = dict(zip(published.GROUPS, rates, strict=True))
            out.append(
                {"figures": _whose(method), "method": method} | {group: theirs.get(group) for group in groups}
            )
    return out


def table_4(rows: Iterable[Row], parts: Mapping[str, str]) -> list[dict[str, Any]]:
    """Remake Table IV: errors with parts of the paper's method switched off, beside the paper's.

    Args:
        rows: runs whose methods name the parts among their options, such as ``mtpcr-geo:focus=no``.
        parts: the option's name for each of "RES", "FOCUS" and "IE"; on where an option is not given.

    """
    out: list[dict[str, Any]] = []
    for (method, pair), own in grouped(rows, "method", "pair").items():
        options = options_of(method)
        if not any(name in options for name in parts.values()):
            continue
        sums = summarise(own)
        line: dict[str, Any] = {"figures": "measured here", "method": method, "pair": pair}
        line |= {part: bool(options.get(name, True)) for part, name in parts.items()}
        out.append(
            line | {name: sums[f"{name}_mean"] for name in ("rotation_deg", "translation_m", "rmsd_m")}
        )
    if not out:
        return out
    for entry in published.TABLE_IV:
        for pair, errors in (("A03-G05", entry.a03_g05), ("A06-G01", entry.a06_g01)):
            line = {"figures": "paper, GrAco", "method": "MT-PCR", "pair": pair}
            line |= {"RES": entry.res, "FOCUS": entry.focus, "IE": entry.ie}
            out.append(line | dict(zip(("rotation_deg", "translation_m", "rmsd_m"), errors, strict=True)))
    return out


def combination_of(pair: str) -> str:
    """Find the paper's combination in a pair's name: "standin_A03-G05" gives "A03-G05"."""
    for combination in published.COMBINATIONS:
        if combination.name in pair:
            return combination.name
    return ""


def _place(pair: str) -> int | None:
    names = [combination.name for combination in published.COMBINATIONS]
    name = combination_of(pair)
    return names.index(name) if name else None


def _whose(method: str) -> str:
    return "paper, GrAco, not printed" if method in published.UNPRINTED else "paper, GrAco"


def to_markdown(lines: Sequence[Mapping[str, Any]], form: Callable[[Any], str] | None = None) -> str:
    """Write lines as a Markdown table; the columns are those of all lines, in order of appearance."""
    if not lines:
        return ""
    columns = list(dict.fromkeys(key for line in lines for key in line))
    write = form or _cell
    text = ["| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
    text += ["| " + " | ".join(write(line.get(column)) for column in columns) + " |" for line in lines]
    return "\n".join(text) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        return f"{value:.1f}" if abs(value) >= 100 else f"{value:.3f}"
    return str(value)

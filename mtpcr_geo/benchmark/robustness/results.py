"""The rows of the robustness benchmark: a CSV that grows run by run, and its sums as tables."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from mtpcr_geo.benchmark.metrics import rotation_error_deg
from mtpcr_geo.benchmark.robustness.coverage import covered
from mtpcr_geo.benchmark.robustness.runner import COLUMNS, Row
from mtpcr_geo.benchmark.robustness.uniformity import null_uniformity
from mtpcr_geo.benchmark.tables import to_markdown
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import InputError, OptionError, OutputError

_TEXT = ("case", "suite", "site", "kind", "place", "level", "verdict", "reason", "swap_verdict")


class RowFile:
    """A CSV of rows, opened to append; use as a context manager.

    A half line that an interruption left is cut off, so that its run is made again.

    Args:
        path: made if missing, its folder too.

    Raises:
        OptionError: if the file has other columns.
        OutputError: if it cannot be written.

    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        head = _line({name: name for name in COLUMNS})
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            data = self.path.read_bytes() if self.path.exists() else b""
            if not data.endswith(b"\n"):
                data = data[: data.rfind(b"\n") + 1]
                self.path.write_bytes(data or head.encode())
            elif not data.startswith(head.encode()):
                raise OptionError(f"{self.path} has other columns than this version; choose another folder")
            self._file = self.path.open("a", encoding="utf-8", newline="")
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def append(self, row: Row) -> None:
        """Write a row, and have it on disk."""
        self._file.write(_line({name: _written(row.get(name)) for name in COLUMNS}))
        self._file.flush()


def read_rows(path: Path) -> list[Row]:
    """Read rows as they were before they were written; what was not known is None.

    Raises:
        InputError: if the file cannot be read, or is no such file.

    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot read the results {path}: {error.strerror}") from error
    whole = text[: text.rfind("\n") + 1]
    # csv limits a field to 128 KiB, which metrics stay well below
    lines = list(csv.DictReader(io.StringIO(whole)))
    try:
        return [{name: _read(name, value) for name, value in line.items()} for line in lines]
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path} is damaged ({error}); remove the line to run it again") from error


def _line(values: Mapping[str, Any]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, COLUMNS, lineterminator="\n").writerow(values)
    return text.getvalue()


def _written(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return " ".join(value.split())
    return json.dumps(value)


def _read(name: str, text: str) -> Any:
    if name in _TEXT:
        return text
    return json.loads(text) if text else None


def false_accept(row: Row) -> bool:
    """Return whether a run was accepted though it is wrong, or has no right answer."""
    return bool(row["verdict"] == "accepted" and not (row["has_truth"] and row["right"]))


def group_of(row: Row) -> str:
    """Return under what a run is summed up in its suite: its site, or what the suite varies."""
    if row["suite"] == "discs":
        return f"radius {row['radius']:g} m"
    if row["suite"] == "overlap":
        return f"overlap {100 * row['asked_overlap']:g} %"
    if row["suite"] in ("plots", "repeating", "repeating-apart", "unrelated"):
        return str(row["kind"])
    return str(row["site"])


def summarise(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Sum up runs by suite and group, with a line for all of each suite.

    Returns:
        Lines with the counts ``runs``, ``accepted``, ``right`` (whatever the verdict), ``right_accepted``,
        ``wrong_accepted``, ``precise`` and ``failed``; medians and worst of the errors of the right runs; and
        the median times.

    """
    rows = list(rows)
    lines = []
    for suite in dict.fromkeys(row["suite"] for row in rows):
        mine = [row for row in rows if row["suite"] == suite]
        groups = list(dict.fromkeys(group_of(row) for row in mine))
        for group in groups:
            part = [row for row in mine if group_of(row) == group]
            lines.append({"suite": suite, "group": group, **_sums(part)})
        if len(groups) > 1:
            lines.append({"suite": suite, "group": "all", **_sums(mine)})
    return lines


def _sums(rows: Sequence[Row]) -> dict[str, Any]:
    known = any(row["has_truth"] for row in rows)
    right = [row for row in rows if row["right"]]

    def figure(name: str, how: Callable[[Any], Any]) -> float | None:
        values = [abs(row[name]) for row in right if row[name] is not None]
        return float(how(values)) if values else None

    line: dict[str, Any] = {
        "runs": len(rows),
        "accepted": sum(row["verdict"] == "accepted" for row in rows),
        "right": len(right) if known else None,
        "right_accepted": sum(row["verdict"] == "accepted" for row in right) if known else None,
        "wrong_accepted": sum(map(false_accept, rows)),
        "precise": sum(bool(row["precise"]) for row in rows) if known else None,
        "doubtful": sum(row["verdict"] == "doubtful" for row in rows),
        "failed": sum(row["verdict"] == "failed" for row in rows),
    }
    for short, name in (("rot_deg", "rot_err_deg"), ("plan_m", "plan_err_m"), ("dz_m", "dz_err_m")):
        line[f"{short}_median"] = figure(name, np.median)
        line[f"{short}_max"] = figure(name, np.max)
    for name in ("time_s", "cpu_s"):
        times = [row[name] for row in rows if row[name] is not None]
        line[f"{name}_median"] = float(np.median(times)) if times else None
    return line


def spreads(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Measure how far the poses of several starts on the same clouds lie apart.

    Returns:
        A line for each set of clouds with two right runs or more: how many, the largest distance between two
        poses at the middle of the overlap (millimetres), and the largest angle between two (degrees).

    """
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row["right"] and row["T_answer_true"] is not None:
            key = tuple(row[name] for name in ("suite", "site", "kind", "place", "radius", "asked_overlap"))
            groups.setdefault(key, []).append(row)
    lines = []
    for key, part in groups.items():
        if len(part) < 2:
            continue
        poses = [np.array(row["T_answer_true"], np.float64) for row in part]
        middle = np.array(part[0]["middle"], np.float64)
        at = np.array([transforms.apply(T, middle[None])[0] for T in poses])
        apart = np.linalg.norm(at[:, None] - at[None], axis=2)
        turned = max(rotation_error_deg(a, b) for a in poses for b in poses)
        lines.append(
            {
                "suite": key[0],
                "site": key[1],
                "right_runs": len(part),
                "apart_mm": 1000.0 * float(apart.max()),
                "apart_median_mm": 1000.0 * float(np.median(apart[np.triu_indices(len(part), 1)])),
                "apart_deg": turned,
            }
        )
    return lines


def swaps(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """List the runs that were made both ways."""
    names = ("site", "start", "verdict", "right", "swap_verdict", "swap_mm", "swap_deg")
    return [{name: row[name] for name in names} for row in rows if row["swap_verdict"]]


def report(rows: Sequence[Row]) -> str:
    """Write the sums as Markdown."""
    text = [
        "# Robustness\n",
        "Right: within 5 degrees, and 2 m in the middle of the overlap, whatever the verdict; precise: "
        "within 0.2 degrees and 0.5 m. Errors are those of the right runs. Runs of repeating-apart and "
        "unrelated have no right answer.\n",
        to_markdown(summarise(rows)),
    ]
    right = [row for row in rows if row["right"]]
    coverage = [
        {"suite": suite, **line}
        for suite in dict.fromkeys(row["suite"] for row in right)
        for line in covered([row for row in right if row["suite"] == suite])
    ]
    for title, lines in (
        ("Without a right answer: share of probabilities below p", null_uniformity(rows)),
        ("True errors within the region of 95 %, right runs", coverage),
        ("Spread over starts", spreads(rows)),
        ("Both ways", swaps(rows)),
    ):
        if lines:
            text += [f"## {title}\n", to_markdown(lines)]
    wrong = [
        {name: row[name] for name in ("case", "verdict", "rot_err_deg", "plan_err_m", "time_s", "reason")}
        for row in rows
        if false_accept(row) or row["verdict"] == "failed" or (row["has_truth"] and not row["right"])
    ]
    if wrong:
        text += ["## Wrong, failed or wrongly accepted\n", to_markdown(wrong)]
    return "\n".join(text)

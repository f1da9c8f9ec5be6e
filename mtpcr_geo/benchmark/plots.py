"""Plots of runs: cumulative error curves, success against overlap and against yaw (matplotlib)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.methods import options_of
from mtpcr_geo.benchmark.tables import LENIENT, Row, answered, grouped, success
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import MissingPartError

# hues that also differ in lightness, so that they stay apart in grey and for most colour-blind readers
COLOURS = ("#0b3c8c", "#d1491b", "#2a9d6f", "#8b5fbf", "#c99a1d", "#56a3d9", "#7a7a7a", "#b5446e")
DASHES: tuple[str, ...] = ("-", "--", "-.", ":")


def cumulative(errors: Sequence[float], runs: int) -> tuple[Floats, Floats]:
    """Return the steps of a cumulative curve: errors in rising order, and the percentage of runs up to each.

    Args:
        errors: of the runs with an answer.
        runs: all runs; those without an answer never enter the curve.

    """
    x = np.sort(np.asarray(errors, np.float64))
    return x, 100.0 * np.arange(1, len(x) + 1) / max(runs, 1)


def binned(values: Sequence[float], right: Sequence[bool], edges: Sequence[float]) -> list[dict[str, float]]:
    """Return the success rate in each bin that holds runs: its middle, percentage, and number of runs.

    Args:
        values: what to sort runs by.
        right: which are successes.
        edges: of the bins, rising; a bin holds its lower edge, the last one its upper edge too.

    """
    x, ok, e = np.asarray(values, np.float64), np.asarray(right, bool), np.asarray(edges, np.float64)
    which = np.clip(np.searchsorted(e, x, side="right") - 1, 0, len(e) - 2)
    inside = (x >= e[0]) & (x <= e[-1])
    out = []
    for k in range(len(e) - 1):
        chosen = inside & (which == k)
        if chosen.any():
            rate = 100.0 * float(ok[chosen].mean())
            out.append(
                {"middle": float(e[k] + e[k + 1]) / 2, "success_pct": rate, "runs": float(chosen.sum())}
            )
    return out


def draw_all(rows: Sequence[Row], files: Mapping[str, Path], note: str = "") -> None:
    """Draw plots as PNG.

    Args:
        rows: runs; at least one.
        files: where each plot goes, by its name in `PLOTS`.
        note: printed small below each, such as what the data are.

    Raises:
        MissingPartError: if matplotlib is not installed.

    """
    plt = pyplot()
    for name, path in files.items():
        wide = 10.0 if name == "cumulative_errors" else 6.4
        figure = plt.figure(figsize=(wide, 4.2), layout="constrained")
        PLOTS[name](figure, rows)
        if note:
            figure.supxlabel(note, fontsize=7, color="0.4")
        figure.savefig(path, dpi=150)
        plt.close(figure)


def _draw_cumulative(figure: Any, rows: Sequence[Row]) -> None:
    axes = figure.subplots(1, 2, sharey=True)
    for axis, key, unit, limit in zip(
        axes,
        ("rotation_deg", "translation_m"),
        ("rotation error, degrees", "translation error, m"),
        LENIENT,
        strict=True,
    ):
        for k, ((method,), own) in enumerate(grouped(rows, "method").items()):
            x, y = cumulative([row[key] for row in own if answered(row)], len(own))
            if len(x):
                # from the axis up, and not below a millimetre or a thousandth of a degree
                x, y = np.maximum(np.r_[x[0], x], 1e-3), np.r_[0.0, y]
                axis.step(x, y, where="post", label=_short(method), **_style(k))
        axis.axvline(limit, color="0.7", linewidth=1, zorder=0)
        axis.set(xscale="log", xlabel=unit, ylim=(0, 102))
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("runs up to this error, % of all")
    _legend(axes[0])


def _draw_overlap(figure: Any, rows: Sequence[Row]) -> None:
    axis = figure.subplots()
    shares = [100 * min(row["overlap_source"], row["overlap_target"]) for row in rows]
    top = max(10.0, max(shares, default=10.0))
    # finer where it is hard
    edges = [0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 60.0, 80.0, 100.0]
    edges = [edge for k, edge in enumerate(edges) if k == 0 or edges[k - 1] < top]
    _rates(axis, rows, lambda row: 100 * min(row["overlap_source"], row["overlap_target"]), edges)
    axis.set(xlabel="overlap, % of the cloud that shares less", ylabel=_rate_name(), xlim=(edges[-1], 0.0))


def _draw_yaw(figure: Any, rows: Sequence[Row]) -> None:
    axis = figure.subplots()
    top = max((row["yaw_deg"] for row in rows), default=360.0)
    edges = np.arange(0.0, (360.0 if top > 90.0 else 90.0) + 1, 30.0 if top > 90.0 else 15.0)
    _rates(axis, rows, lambda row: float(row["yaw_deg"]), edges.tolist())
    axis.set(xlabel="yaw of the start, degrees", ylabel=_rate_name())


def _rates(axis: Any, rows: Sequence[Row], of: Callable[[Row], float], edges: Sequence[float]) -> None:
    for k, ((method,), own) in enumerate(grouped(rows, "method").items()):
        bins = binned([of(row) for row in own], [success(row) for row in own], edges)
        axis.plot(
            [b["middle"] for b in bins],
            [b["success_pct"] for b in bins],
            marker="o",
            markersize=4,
            label=_short(method),
            **_style(k),
        )
    axis.set_ylim(-3, 103)
    axis.grid(alpha=0.25)
    _legend(axis)


def _rate_name() -> str:
    return f"success ({LENIENT[0]:g} degrees, {LENIENT[1]:g} m), %"


def _short(method: str) -> str:
    """Return an external method by its file's name, "external:file=there/codem.json" as "codem"."""
    file = options_of(method).get("file")
    return method if file is None else Path(str(file)).stem


def _style(k: int) -> dict[str, Any]:
    return {
        "color": COLOURS[k % len(COLOURS)],
        "linestyle": DASHES[(k // len(COLOURS)) % len(DASHES)],
        "linewidth": 2.2 if k == 0 else 1.5,
    }


def _legend(axis: Any) -> None:
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8, frameon=False)


def pyplot() -> Any:
    """Return matplotlib's pyplot, for files only.

    Raises:
        MissingPartError: if it is not installed.

    """
    try:
        import matplotlib
    except ImportError as error:
        raise MissingPartError(
            "plots need matplotlib, which is not installed; run pip install 'mtpcr-geo[benchmark]'"
        ) from error
    # files only: no display is asked for
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    return plt


PLOTS: dict[str, Callable[[Any, Sequence[Row]], None]] = {
    "cumulative_errors": _draw_cumulative,
    "success_overlap": _draw_overlap,
    "success_yaw": _draw_yaw,
}


def draw_radii(rows: Sequence[Row], path: Path) -> None:
    """Draw the shares of right and accepted runs against the radius of discs, as PNG.

    Args:
        rows: of the robustness benchmark's suite discs; at least one.
        path: where to.

    Raises:
        MissingPartError: if matplotlib is not installed.

    """
    plt = pyplot()
    figure = plt.figure(figsize=(6.4, 4.2), layout="constrained")
    axis = figure.subplots()
    radii = sorted({row["radius"] for row in rows})
    runs = [[row for row in rows if row["radius"] == radius] for radius in radii]
    drawn: dict[str, Callable[[Row], bool]] = {
        "right": lambda row: bool(row["right"]),
        "right and accepted": lambda row: bool(row["right"]) and row["verdict"] == "accepted",
        "wrong and accepted": lambda row: not row["right"] and row["verdict"] == "accepted",
    }
    for k, (name, good) in enumerate(drawn.items()):
        shares = [100.0 * float(np.mean([good(row) for row in part])) for part in runs]
        axis.plot(radii, shares, marker="o", label=name, **_style(k))
    axis.set(xlabel="radius of the disc, m", ylabel="% of runs", ylim=(-2, 102))
    axis.grid(alpha=0.25)
    _legend(axis)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def draw_reliability(lines: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the share of right runs against the probability that was said, as PNG.

    Args:
        lines: bins with ``said``, ``right`` and ``runs``, see `robustness.calibrate.reliability`.
        path: where to.

    Raises:
        MissingPartError: if matplotlib is not installed.

    """
    plt = pyplot()
    figure = plt.figure(figsize=(4.8, 4.6), layout="constrained")
    axis = figure.subplots()
    axis.plot([0, 100], [0, 100], color="0.6", linewidth=1)
    said, right = ([100.0 * float(line[name]) for line in lines] for name in ("said", "right"))
    axis.plot(said, right, marker="o", **_style(0))
    for line, x, y in zip(lines, said, right, strict=True):
        axis.annotate(f"{line['runs']} runs", (x, y), xytext=(6, -10), textcoords="offset points", fontsize=8)
    axis.set(xlabel="probability said, %", ylabel="runs that are right, %", xlim=(-3, 112), ylim=(-6, 104))
    axis.grid(alpha=0.25)
    figure.savefig(path, dpi=150)
    plt.close(figure)

"""How time and memory grow with the number of points: a real pair, densified, registered at each size.

Beside the registration, in the same run, stand yardsticks: what laspy takes to read both files, and to read
and write the source; what PDAL takes to rasterise and to move it, where it is installed.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.yardsticks import Measured, job, measured
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.progress import NoProgress, Progress

LARGEST = 1_000.0
"""Millions of points of each cloud at most."""
HEIGHT_SHARE = 0.1
"""Spread of the heights of points put beside a real one, as a share of that in plan."""
JOB_COLUMNS = ("million_points", "job", "wall_s", "cpu_s", "peak_mib")
STAGE_COLUMNS = (
    "million_points", "stage", "seconds", "cpu_s", "read_mb", "written_mb", "memory_mb", "peak_memory_mb",
)  # fmt: skip


def densify(path: Path, out: Path, count: int, seed: int = 0) -> None:
    """Write a cloud of `count` points as LAS 1.4: the points of a real one, each with others beside it.

    They lie around it by half the mean distance between points in plan, and keep its attributes. The order
    is that of the file, again and again, so that it compresses as a survey of many flight lines does.

    Args:
        path: the real cloud; held in memory.
        out: the file to write.
        count: points to write.
        seed: of where they lie.

    """
    import laspy

    from mtpcr_geo.io.las import open_cloud
    from mtpcr_geo.method.bev import coverage_of

    cloud = open_cloud(path)
    las = laspy.read(path)
    xyz = cloud.to_array()
    spread = 0.5 / np.sqrt(coverage_of(xyz - xyz.min(axis=0)).per_m2)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.mean(axis=0))
    if cloud.crs is not None:
        header.add_crs(cloud.crs)
    rng = np.random.default_rng(seed)
    kept = ("intensity", "classification", "return_number", "number_of_returns", "gps_time")
    names = [name for name in kept if name in las.point_format.dimension_names]
    with laspy.open(str(out), "w", header=header, do_compress=True) as writer:
        for start in range(0, count, len(xyz)):
            n = min(len(xyz), count - start)
            points = laspy.ScaleAwarePointRecord.zeros(n, header=header)
            moved = xyz[:n]
            if start:
                moved = moved + rng.normal(0.0, spread, (n, 3)) * [1.0, 1.0, HEIGHT_SHARE]
            points.x, points.y, points.z = moved.T
            for name in names:
                points[name] = np.asarray(las[name][:n])
            writer.write_points(points)


def run_scale(
    folder: Path,
    millions: Sequence[float],
    out: Path,
    *,
    threads: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Measure registration and yardsticks at each size; write tables and a plot.

    Args:
        folder: of a pair, ``source.laz`` and ``target.laz``.
        millions: points of each cloud.
        out: folder of the results: ``jobs.csv``, ``stages.csv``, ``scale.png``, and the clouds, which are
            removed again.
        threads: cores for this package; 0 takes all.
        progress: where to report.

    Returns:
        The rows of ``jobs.csv``.

    Raises:
        OptionError: if a size is of no use.
        MtpcrError: if a job fails.

    """
    if not millions or not all(0.1 <= size <= LARGEST for size in millions):
        raise OptionError(f"--scale takes millions of points, 0.1 to {LARGEST:g}, such as '1 3 10'")
    out.mkdir(parents=True, exist_ok=True)
    jobs: list[dict[str, Any]] = []
    stages: list[dict[str, Any]] = []
    with (progress or NoProgress()).task("measuring", len(millions)) as advance:
        for size in sorted(millions):
            found, by_stage = _measure(folder, size, out, threads)
            jobs += [{"million_points": size, **row} for row in found]
            stages += [{"million_points": size, **row} for row in by_stage]
            # what was measured is kept if a larger size ends the run
            _write_table(out / "jobs.csv", JOB_COLUMNS, jobs)
            _write_table(out / "stages.csv", STAGE_COLUMNS, stages)
            advance(1)
    draw(jobs, stages, out / "scale.png")
    return jobs


def _measure(
    folder: Path, size: float, out: Path, threads: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    source, target, moved = (out / f"{name}.laz" for name in ("source", "target", "moved"))
    try:
        for path in (source, target):
            densify(folder / path.name, path, round(size * 1e6))
        own = [sys.executable, "-m", "mtpcr_geo"]
        limit = ["--threads", str(threads)] if threads else []
        local = [] if _has_crs(source) and _has_crs(target) else ["--local"]
        result = out / "registration"
        register = [*own, "register", str(source), str(target), "-o", str(result), *local, *limit]
        move = [*own, "apply", str(result / "transform.json"), str(source), str(moved), *limit]
        commands: dict[str, list[str]] = {
            "laspy read of both": job("laspy-read", source, target),
            "register": [*register, "--overwrite", "--quiet"],
            "laspy read and write": job("laspy-copy", source, moved),
            "apply": [*move, "--overwrite", "--quiet"],
            "bev": job("bev", source, out / "own.tif"),
        }
        if importlib.util.find_spec("pdal") is not None:
            commands["PDAL writers.gdal"] = job("pdal-bev", source, out / "pdal.tif")
            commands["PDAL filters.transformation"] = job("pdal-move", source, moved)
        rows: list[dict[str, Any]] = []
        stages: list[dict[str, Any]] = []
        for name, command in commands.items():
            if name == "apply" and not (result / "transform.json").is_file():
                continue  # refused: there is nothing to apply
            rows.append({"job": name, **_row(measured(command))})
            if name == "register":
                stages = _stages(result / "run.json")
        return rows, stages
    finally:
        for path in (source, target, moved):
            path.unlink(missing_ok=True)


def _has_crs(path: Path) -> bool:
    from mtpcr_geo.io.las import open_cloud

    return open_cloud(path).crs is not None


def _row(took: Measured) -> dict[str, float | None]:
    peak = None if took.peak_mib is None else round(took.peak_mib, 1)
    return {"wall_s": round(took.wall_s, 3), "cpu_s": round(took.cpu_s, 3), "peak_mib": peak}


def _stages(path: Path) -> list[dict[str, Any]]:
    run = json.loads(path.read_text(encoding="utf-8"))
    rows = []
    for record in run["stages"]:
        row = {key: record.get(key) for key in STAGE_COLUMNS if key not in ("million_points", "stage")}
        rows.append({"stage": record["tag"], **row})
    return rows


def _write_table(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def draw(jobs: Sequence[dict[str, Any]], stages: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw time by job, time by stage and memory over the number of points, as PNG (matplotlib).

    Args:
        jobs, stages: rows of the two tables.
        path: the file.

    Raises:
        MissingPartError: if matplotlib is not installed.

    """
    from mtpcr_geo.benchmark.plots import COLOURS, DASHES, pyplot

    plt = pyplot()
    sizes = sorted({row["million_points"] for row in jobs})
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")

    def lines(axis: Any, rows: Sequence[dict[str, Any]], key: str, value: str, names: Sequence[str]) -> None:
        for k, name in enumerate(names):
            found = {row["million_points"]: row[value] for row in rows if row[key] == name}
            at = [size for size in sizes if found.get(size) is not None]
            axis.plot(
                at,
                [found[size] for size in at],
                marker="o",
                color=COLOURS[k % len(COLOURS)],
                linestyle=DASHES[k // len(COLOURS) % len(DASHES)],
                label=name,
            )
        axis.set_xscale("log")
        axis.set_xlabel("million points of each cloud")
        axis.grid(alpha=0.3)
        if names:
            axis.legend(fontsize=8)

    lines(left, jobs, "job", "wall_s", list(dict.fromkeys(row["job"] for row in jobs)))
    # stages that never take a twentieth of a run would hide the others
    total = {size: sum(row["seconds"] for row in stages if row["million_points"] == size) for size in sizes}
    large = [row["stage"] for row in stages if row["seconds"] > 0.05 * total[row["million_points"]]]
    lines(middle, stages, "stage", "seconds", list(dict.fromkeys(large)))
    lines(right, jobs, "job", "peak_mib", list(dict.fromkeys(row["job"] for row in jobs)))
    labels = {left: "wall time, s", middle: "wall time of a stage, s", right: "peak memory, MiB"}
    for axis, label in labels.items():
        axis.set_ylabel(label)
    left.set_yscale("log")
    middle.set_yscale("log")
    # room for the legend above the lines
    right.set_ylim(0, 1.5 * max((row["peak_mib"] or 0.0 for row in jobs), default=1.0))
    figure.savefig(path, dpi=90)
    plt.close(figure)

"""How surveys and batches do at size: a made-up region, its survey, and scans from all over it.

The commands themselves are run, each in a process of its own, and measured: `survey build` with one and with
two workers, and killed and resumed; `register` of scans against the survey, with and without a rough place;
`batch` with one and with two workers, one of which is killed.
"""

from __future__ import annotations

import csv
import hashlib
import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.metrics import rotation_error_deg
from mtpcr_geo.benchmark.region import Region, write_scan, write_tile
from mtpcr_geo.benchmark.yardsticks import Measured, measured
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import MtpcrError, OptionError
from mtpcr_geo.core.progress import NoProgress, Progress

TILE_M = 500.0
PER_M2 = 4.0
RADIUS_M = 100.0
"""Radius of what a scan sees."""
NEAR_M = 100.0
"""How well the place of a scan is known, where it is."""
RIGHT_M, RIGHT_DEG = 2.0, 5.0
LARGEST_KM = 50.0
BUILT_BEFORE_KILL = 0.4
"""Share of the tiles that are read, and of the jobs that are done, when a process is killed."""
JOB_COLUMNS = ("job", "wall_s", "cpu_s", "peak_mib", "same")
PLACE_COLUMNS = (
    "place", "x", "y", "near", "verdict", "probability", "right", "plan_m", "height_m", "rotation_deg",
    "margin", "wall_s", "cpu_s", "peak_mib", "reason",
)  # fmt: skip


@dataclass(frozen=True)
class Place:
    """A scan of the region and where it belongs.

    Attributes:
        number: of the place.
        scan: the file.
        T: 4x4 from its coordinates to those of the region's CRS.
        near: (2,) a place in the CRS within `NEAR_M` of the mean of its points.

    """

    number: int
    scan: Path
    T: Floats
    near: tuple[float, float]


def run_survey(
    edge_km: float,
    places: int,
    out: Path,
    *,
    seed: int = 0,
    workers: int = 2,
    batch: int = 0,
    progress: Progress | None = None,
) -> str:
    """Make a region, build its survey, and register scans from random places of it; write tables.

    What is there already is not made again, so that a run that was stopped goes on.

    Args:
        edge_km: edge of the region, kilometres.
        places: how many scans, of 200 m across.
        out: folder of the tiles, scans, surveys and tables ``jobs.csv`` and ``places.csv``.
        seed: of region and places.
        workers: processes of the builds and batches that have several.
        batch: jobs of a batch, each of one of the places; 0 for none.
        progress: where to report.

    Returns:
        A report.

    Raises:
        OptionError: if a size is of no use.
        MtpcrError: if a job fails.

    """
    tiles_across = round(edge_km * 1000.0 / TILE_M)
    if tiles_across < 1 or edge_km > LARGEST_KM:
        raise OptionError(f"--survey takes kilometres, {TILE_M / 1000:g} to {LARGEST_KM:g}")
    progress = progress or NoProgress()
    out.mkdir(parents=True, exist_ok=True)
    region = Region(seed)
    tiles = _made_tiles(region, tiles_across, out / "tiles", progress)
    found = _made_scans(region, tiles_across * TILE_M, places, out / "scans", seed)
    jobs = _read(out / "jobs.csv")

    def noted(name: str, job: Callable[[], dict[str, Any]]) -> None:
        if not any(row["job"] == name for row in jobs):
            jobs.append({"job": name, **job()})
            _write(out / "jobs.csv", JOB_COLUMNS, jobs)

    survey = out / "survey"
    noted("build, 1 worker", lambda: _row(measured(_build(tiles, survey, 1))))
    several = f"build, {workers} workers"
    noted(several, lambda: _compared(_build(tiles, out / "several", workers), out / "several", survey))
    noted(f"{several}, killed and resumed", lambda: _resumed(tiles, out / "resumed", workers, survey))
    rows = _read(out / "places.csv")
    with progress.task("registering", 2 * len(found)) as advance:
        for place in found:
            for near in (False, True):
                done = {(int(row["place"]), row["near"]) for row in rows}
                if (place.number, str(near)) not in done:
                    rows.append(_registered(place, near, survey, out / "registered"))
                    _write(out / "places.csv", PLACE_COLUMNS, rows)
                    rows = _read(out / "places.csv")
                advance(1)
    if batch:
        _write_batch(found, batch, out / "batch_jobs.csv", survey)
        one, two = out / "batch_one", out / "batch_several"
        command = [*_own("batch", out / "batch_jobs.csv", "--source-crs", "local", "--quiet")]
        noted("batch, 1 worker", lambda: _row(measured([*command, "-o", str(one), "--workers", "1"])))
        more = [*command, "-o", str(two), "--workers", str(workers)]
        noted(f"batch, {workers} workers", lambda: {**_row(measured(more)), "same": _same_rows(one, two)})
        third = out / "batch_killed"
        killed = [*command, "-o", str(third), "--workers", str(workers)]
        name = f"batch, {workers} workers, one killed"
        noted(name, lambda: _worker_killed(killed, third, batch, one))
    return report(jobs, rows)


def _own(*words: str | Path) -> list[str]:
    return [sys.executable, "-m", "mtpcr_geo", *map(str, words)]


def _build(tiles: Path, survey: Path, workers: int) -> list[str]:
    return _own("survey", "build", tiles, "-o", survey, "--workers", str(workers), "--quiet")


def _made_tiles(region: Region, across: int, folder: Path, progress: Progress) -> Path:
    folder.mkdir(exist_ok=True)
    with progress.task("making tiles", across**2) as advance:
        for i in range(across):
            for j in range(across):
                low = (i * TILE_M, j * TILE_M)
                done = folder / f"tile_{low[0]:06.0f}_{low[1]:06.0f}.done"
                if not done.exists():
                    write_tile(folder, region, low, TILE_M, PER_M2)
                    done.touch()
                advance(1)
    return folder


def _made_scans(region: Region, edge_m: float, count: int, folder: Path, seed: int) -> list[Place]:
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng([seed, 6])
    made = []
    for number in range(count):
        middle = rng.uniform(RADIUS_M, edge_m - RADIUS_M, 2)
        away, angle = NEAR_M * np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * np.pi)
        path, truth = folder / f"scan{number:03d}.laz", folder / f"scan{number:03d}.json"
        if not truth.exists():
            T, points = write_scan(path, region, (float(middle[0]), float(middle[1])), number, RADIUS_M)
            known = {"T_region_scan": T.tolist(), "mean_of_points": points.tolist()}
            truth.write_text(json.dumps(known), encoding="utf-8")
        known = json.loads(truth.read_text(encoding="utf-8"))
        T = np.array(known["T_region_scan"])
        # --near says where the mean of the points lies
        near = np.array(known["mean_of_points"]) + away * np.array([np.cos(angle), np.sin(angle)])
        made.append(Place(number, path, T, (float(near[0]), float(near[1]))))
    return made


def _registered(place: Place, near: bool, survey: Path, out: Path) -> dict[str, Any]:
    """Register a scan to the survey, and compare with the truth at its middle."""
    command = _own(
        "register", place.scan, survey, "-o", out, "--source-crs", "local", "--overwrite", "--quiet"
    )
    if near:
        command += ["--near", *(f"{value:.2f}" for value in place.near), "--within", f"{NEAR_M:g}"]
    used = measured(command)
    run = json.loads((out / "run.json").read_text(encoding="utf-8"))
    row: dict[str, Any] = {
        "place": place.number,
        "x": round(float(place.T[0, 3]), 2),
        "y": round(float(place.T[1, 3]), 2),
        "near": near,
        "verdict": run["verdict"],
        "probability": run["probability"],
        "margin": run["metrics"].get("hypothesis_margin"),
        "reason": (run["reasons"] or [""])[0],
        "right": False,
        **_row(used),
    }
    if run["T_target_source"] is not None:
        T = np.array(run["T_target_source"])
        # the middle of the scan is the origin of its coordinates
        off = transforms.apply(T, np.zeros((1, 3)))[0] - place.T[:3, 3]
        plan, turned = float(np.hypot(off[0], off[1])), rotation_error_deg(T, place.T)
        row |= {
            "plan_m": round(plan, 4),
            "height_m": round(float(off[2]), 4),
            "rotation_deg": round(turned, 4),
        }
        row["right"] = bool(np.linalg.norm(off) < RIGHT_M and turned < RIGHT_DEG)
    return row


def _compared(command: Sequence[str], survey: Path, other: Path) -> dict[str, Any]:
    return {**_row(measured(command)), "same": _digest(survey) == _digest(other)}


def _resumed(tiles: Path, survey: Path, workers: int, other: Path) -> dict[str, Any]:
    """Kill a build with all its processes, build again, and compare; the time is that of the second build."""
    wanted = int(BUILT_BEFORE_KILL * len(list(tiles.glob("*.laz"))))
    command = _build(tiles, survey, workers)
    with _started(command) as process:
        _wait(process, lambda: len(list(survey.glob("tiles/*.npz"))) >= wanted)
        os.killpg(process.pid, signal.SIGKILL)
    return _compared(command, survey, other)


def _worker_killed(command: Sequence[str], folder: Path, jobs: int, other: Path) -> dict[str, Any]:
    """Run a batch and kill one of its workers in the middle."""
    psutil: Any = importlib.import_module("psutil")  # Dask brings it
    start = time.perf_counter()
    with _started(command) as process:
        _wait(process, lambda: len(list(folder.glob("rows/*.json"))) >= BUILT_BEFORE_KILL * jobs)
        children = psutil.Process(process.pid).children(recursive=True)
        workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        if not workers:
            raise MtpcrError("the batch ended before one of its workers could be killed; give it more jobs")
        workers[0].kill()
        process.wait()
    if process.returncode:
        raise MtpcrError(f"a batch one of whose workers was killed ended with {process.returncode}")
    return {"wall_s": round(time.perf_counter() - start, 2), "same": _same_rows(folder, other)}


def _started(command: Sequence[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def _wait(process: subprocess.Popen[bytes], ready: Callable[[], bool]) -> None:
    while process.poll() is None and not ready():
        time.sleep(0.05)


def _digest(survey: Path) -> str:
    """Return a hash of all rasters of a survey."""
    found = hashlib.sha256()
    for path in sorted(survey.glob("bev/**/*.tif")):
        found.update(path.relative_to(survey).as_posix().encode())
        found.update(path.read_bytes())
    return found.hexdigest()


def _write_batch(places: Sequence[Place], count: int, path: Path, survey: Path) -> None:
    columns = ("name", "source", "target", "near", "within")
    chosen = (places[k % len(places)] for k in range(count))
    rows = [
        {
            "name": f"job{k:03d}",
            "source": place.scan.absolute(),
            "target": survey.absolute(),
            "near": f"{place.near[0]:.2f} {place.near[1]:.2f}",
            "within": f"{NEAR_M:g}",
        }
        for k, place in enumerate(chosen)
    ]
    _write(path, columns, rows)


def _same_rows(one: Path, other: Path) -> bool:
    """Return whether two batches came to the same verdicts and the same matrices."""
    left, right = (_read(folder / "batch.csv") for folder in (one, other))
    keys = [key for key in (left[0] if left else {}) if key not in ("seconds", "folder")]
    return [[row[key] for key in keys] for row in left] == [[row[key] for key in keys] for row in right]


def report(jobs: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]]) -> str:
    """Return the tables as text: a line a job, and sums over the places with and without a rough place."""
    lines = []
    for row in jobs:
        same = {"True": ", the same bits", "False": ", NOT the same"}.get(str(row.get("same")), "")
        cpu = f", {float(row['cpu_s']):.1f} s of processors" if row.get("cpu_s") else ""
        peak = f", {float(row['peak_mib']):.0f} MiB" if row.get("peak_mib") else ""
        lines.append(f"{row['job']}: {float(row['wall_s']):.1f} s{cpu}{peak}{same}")
    lines += list(_sums(rows))
    return "\n".join(lines)


def _sums(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    for near in ("False", "True"):
        some = [row for row in rows if str(row["near"]) == near]
        if not some:
            continue
        right = [row for row in some if str(row["right"]) == "True"]
        accepted = [row for row in some if row["verdict"] == "accepted"]
        wrong = [row for row in accepted if str(row["right"]) != "True"]
        wall, cpu, peak = (
            np.array([float(row[key]) for row in some if row[key]]) for key in ("wall_s", "cpu_s", "peak_mib")
        )
        plan = [float(row["plan_m"]) for row in right]
        yield (
            f"{'near' if near == 'True' else 'anywhere'}: {len(right)} of {len(some)} right, "
            f"{len(accepted)} accepted, {len(wrong)} accepted wrongly; "
            f"{np.median(plan) if plan else np.nan:.3f} m off in plan in the median; "
            f"{np.median(wall):.1f} s in the median, {wall.max():.1f} s at most, {np.median(cpu):.1f} s of "
            f"processors, {peak.max(initial=0.0):.0f} MiB at most"
        )


def _row(took: Measured) -> dict[str, Any]:
    peak = None if took.peak_mib is None else round(took.peak_mib, 1)
    return {"wall_s": round(took.wall_s, 2), "cpu_s": round(took.cpu_s, 2), "peak_mib": peak}


def _read(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _write(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)

"""Many registrations: each in a folder of its own, all in one table and on one map.

A job writes its row when it ends, whole or not at all. A batch that is stopped goes on with the jobs that
have no row, with those that failed, and with those whose files or options have changed since.
"""

from __future__ import annotations

import csv
import io
import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import InputError, MtpcrError, OptionError, OutputError, RegistrationError
from mtpcr_geo.core.paths import link_among, read_whole, short
from mtpcr_geo.core.progress import NoProgress, Progress
from mtpcr_geo.core.wording import in_a_line
from mtpcr_geo.registration import Registration, register
from mtpcr_geo.survey import is_survey
from mtpcr_geo.survey.earlier import remove_earlier
from mtpcr_geo.survey.engine import SAME_PATHS, engine_of
from mtpcr_geo.survey.index import write_atomic
from mtpcr_geo.survey.jobs import Job, folder_name
from mtpcr_geo.survey.options import BatchOptions
from mtpcr_geo.survey.register import register_in_survey

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.core.arrays import Floats
    from mtpcr_geo.export.geopackage import Layer

TABLE, MAP, MARK = "batch.csv", "batch.gpkg", "batch.json"
_ROWS, _JOBS = "rows", "jobs"
_FORMULAS = ("=", "+", "-", "@")
DEFAULTS = BatchOptions()


@dataclass(frozen=True)
class Row:
    """What became of a job: a row of the table.

    Attributes:
        name, source, target: the job.
        verdict: accepted, doubtful or refused; "failed" where it could not be run to a verdict.
        probability: of being right, where there is a verdict by a model.
        margin, null_ratio: strength over the next distinct pose, and over the mirrored source.
        x, y: where the middle of the source lies, the mean of its points, in the target's CRS.
        yaw_deg: yaw of the transform.
        sigma_plan_m: standard deviation of the place, metres.
        seconds: wall time of the job.
        reason: the first reason of the verdict, or the error.
        folder: of the job's files, relative to the batch; "" where it left none.
        T_target_source: 4x4 between the coordinates of the files, row by row; empty where none was found.
        footprint: outline of the source in the target's CRS, x and y in turns.
        crs: the target's CRS as WKT; "" where it is local.
        key: what the job was made of.

    """

    name: str
    source: str
    target: str
    verdict: str
    probability: float | None = None
    margin: float | None = None
    null_ratio: float | None = None
    x: float | None = None
    y: float | None = None
    yaw_deg: float | None = None
    sigma_plan_m: float | None = None
    seconds: float = 0.0
    reason: str = ""
    folder: str = ""
    T_target_source: tuple[float, ...] = ()
    footprint: tuple[float, ...] = ()
    crs: str = ""
    key: str = ""

    @property
    def failed(self) -> bool:
        """Whether it was not run to a verdict."""
        return self.verdict == "failed"


@dataclass(frozen=True)
class Batch:
    """What a batch came to.

    Attributes:
        rows: of all jobs, in their order.
        run: how many were run now.
        table, map: the files.

    """

    rows: tuple[Row, ...]
    run: int
    table: Path
    map: Path


@dataclass(frozen=True)
class _Task:
    job: Job
    folder: Path


def run_batch(
    jobs: Sequence[Job],
    folder: str | os.PathLike[str],
    options: BatchOptions = DEFAULTS,
    progress: Progress | None = None,
) -> Batch:
    """Run the jobs of a batch that are not done yet, and write its table and its map.

    Args:
        jobs: what is to be done.
        folder: of the batch; made if it is not there.
        options: of the batch.
        progress: receives the number of jobs done.

    Raises:
        OptionError: if jobs share a name, upper and lower case taken as one, or a name is none of a folder.
        OutputError: if the folder holds something else, or cannot be written.
        MissingPartError: if more than one worker is wanted and Dask is not installed.

    """
    # workers may run in other folders, and on other machines
    folder, jobs = Path(folder).absolute(), [job.placed() for job in jobs]
    progress = progress or NoProgress()
    taken = Counter(job.name.casefold() for job in jobs)
    again = next((job.name for job in jobs if taken[job.name.casefold()] > 1), None)
    if again is not None:
        raise OptionError(f"{taken[again.casefold()]} jobs are called {again}; give each a name of its own")
    wrong = next((job.name for job in jobs if folder_name(job.name) != job.name), None)
    if wrong is not None:
        raise OptionError(f"no job can be called {short(wrong)}; give letters, digits and any of . + - _")
    foreign = os.path.exists(folder) and not os.path.isfile(folder / MARK)
    if foreign and not options.overwrite and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} is there already, and is no batch; name another folder, or --overwrite")
    link = link_among([folder / _ROWS, folder / _JOBS, *(folder / _JOBS / job.name for job in jobs)])
    if link is not None:
        raise OutputError(f"{link} is a link, and a batch keeps its files in its own folder; remove it")
    write_atomic(folder / MARK, json.dumps({"format": "mtpcr-geo batch", "version": 1}))
    # an earlier row of a job that has changed since says nothing of it
    rows = {job.name: _row_of(folder, job) for job in jobs}
    left = [_Task(job, folder) for job in jobs if _is_left(rows[job.name], options)]
    try:
        with engine_of(options, max(len(left), 1)) as engine, progress.task("jobs", len(left)) as advance:
            for outcome in engine.run(do, left, options.retries):
                row = outcome.made
                if row is None:
                    row = _without_result(outcome.item, _failed(outcome.item.job, outcome.error or ""))
                elif row.folder and not _is_here(folder / row.folder):
                    why = f"its worker wrote to another {folder / row.folder} than is here; {SAME_PATHS}"
                    row = _without_result(outcome.item, _failed(outcome.item.job, why))
                else:
                    _write_row(folder, row)
                rows[row.name] = row
                advance(1)
    finally:
        done = tuple(row for row in rows.values() if row is not None)
        table = write_table(folder / TABLE, done)
        chart = write_map(folder / MAP, done)
    return Batch(done, len(left), table, chart)


def do(task: _Task) -> Row:
    """Run one job, and write its row; what a user can cause fails the job alone."""
    job, folder = task.job, task.folder / _JOBS / task.job.name
    started = time.perf_counter()
    given = {"recording": False, **job.options}
    try:
        # what an earlier try of this job left gives way
        run_one = register_in_survey if is_survey(job.target) else register
        result = run_one(job.source, job.target, folder, overwrite=True, **given)
    except RegistrationError as error:
        # a survey that has no place for it refuses it, as a target does
        row = replace(_failed(job, str(error)), verdict="refused")
        return _without_result(task, row, started)
    except MtpcrError as error:
        return _without_result(task, _failed(job, str(error)), started)
    seconds = round(time.perf_counter() - started, 3)
    row = replace(_judged(job, result), seconds=seconds, folder=f"{_JOBS}/{job.name}")
    _write_row(task.folder, row)
    return row


def _without_result(task: _Task, row: Row, started: float | None = None) -> Row:
    """Write the row of a job that left no result, and remove that of an earlier run of another input.

    What the same input gave earlier stays, and so does all where an input cannot be found now: a drive that
    is not there is no other input.
    """
    job = task.job
    seconds = 0.0 if started is None else round(time.perf_counter() - started, 3)
    row = replace(row, seconds=seconds, folder="")
    earlier = _read_row(task.folder, job.name)
    stays = earlier is None or earlier.key == job.key or not job.is_here
    # the row comes first: whatever ends this, the table claims no result that is another's
    _write_row(task.folder, row)
    if stays:
        return row
    try:
        remove_earlier(task.folder / _JOBS / job.name, job.reads)
    except OutputError as error:
        row = replace(row, reason=f"{row.reason}; and an earlier result stays: {error}")
        _write_row(task.folder, row)
    return row


def _is_left(row: Row | None, options: BatchOptions) -> bool:
    return row is None or row.failed or options.overwrite


def _failed(job: Job, why: str) -> Row:
    return Row(job.name, str(job.source), str(job.target), "failed", reason=why, key=job.key)


def _judged(job: Job, result: Registration) -> Row:
    verdict, pair, T = result.verdict, result.pair, result.T_target_source
    metrics = verdict.metrics
    row = Row(
        job.name,
        str(job.source),
        str(job.target),
        verdict.name,
        metrics.get("probability"),
        metrics.get("hypothesis_margin"),
        metrics.get("null_ratio"),
        sigma_plan_m=metrics.get("sigma_plan_m"),
        reason=verdict.reasons[0] if verdict.reasons else "",
        key=job.key,
    )
    if pair is None or T is None or pair.T_target_source is None:
        return row
    sample = pair.source.sample
    # the middle is what --near takes for it: the mean of the points
    marks = np.vstack([_outline(sample), sample.mean(axis=0)])
    *placed, middle = pair.target.link.to_file(transforms.apply(pair.T_target_source, marks))
    x, y = middle[:2]
    crs = pair.target.link.file_crs
    return replace(
        row,
        x=float(x),
        y=float(y),
        yaw_deg=float(np.degrees(transforms.yaw_of(pair.T_target_source[:3, :3]))),
        T_target_source=tuple(float(value) for value in T.ravel()),
        footprint=tuple(float(value) for point in placed for value in point[:2]),
        crs="" if crs is None else crs.to_wkt(),
    )


def _outline(sample: Floats) -> Floats:
    """Return the convex outline of points in plan, closed, (n, 3) at their mean height."""
    from scipy.spatial import ConvexHull

    xy = sample[:, :2]
    hull = xy[ConvexHull(xy).vertices]
    ring = np.vstack([hull, hull[:1]])
    return np.column_stack([ring, np.full(len(ring), sample[:, 2].mean())])


def _is_here(folder: Path) -> bool:
    """Return whether a folder that was just made is here too, on a network's file system as well."""
    # a network's file system may hold for a while that there is none, until the folder above it is listed
    return folder.is_dir() or (folder.parent.is_dir() and folder.name in os.listdir(folder.parent))


def _row_path(folder: Path, name: str) -> Path:
    return folder / _ROWS / f"{name}.json"


def _write_row(folder: Path, row: Row) -> None:
    write_atomic(_row_path(folder, row.name), json.dumps(asdict(row), indent=1))


def _row_of(folder: Path, job: Job) -> Row | None:
    """Return the row of a job; None where there is none that can be read, or it is of another input."""
    row = _read_row(folder, job.name)
    return row if row is not None and row.key == job.key and _is_placed(row) else None


def _read_row(folder: Path, name: str) -> Row | None:
    """Return the row that an earlier run wrote under a name; None where there is none that can be read."""
    from pydantic import TypeAdapter, ValidationError

    try:
        row = TypeAdapter(Row).validate_json(read_whole(_row_path(folder, name)))
    except (OSError, ValidationError, InputError):
        return None
    return row if row.name == name else None


def _is_placed(row: Row) -> bool:
    """Return whether the outline of a row is one, and its CRS one that PROJ works with."""
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    if len(row.footprint) % 2 or not np.isfinite(row.footprint).all():
        return False
    try:
        return not row.crs or bool(Transformer.from_crs(CRS.from_wkt(row.crs), "EPSG:4326").definition)
    except (ProjError, UnicodeError):
        return False


def write_table(path: Path, rows: Sequence[Row]) -> Path:
    """Write the table of a batch as CSV, a row a job."""
    names = [name for name in Row.__dataclass_fields__ if name not in ("footprint", "crs", "key")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        values: list[Any] = []
        for name in names:
            value = getattr(row, name)
            if isinstance(value, tuple):
                value = " ".join(f"{v:.17g}" for v in value)
            elif name in ("source", "target") and value.startswith(_FORMULAS):
                # it is the same path, and no spreadsheet takes it for a formula
                value = f"./{value}"
            values.append(in_a_line(value) if isinstance(value, str) else value)
        writer.writerow(values)
    write_atomic(path, text.getvalue())
    return path


def write_map(path: Path, rows: Sequence[Row]) -> Path:
    """Write the outlines of the sources where they were placed, with verdict and probability, as GeoPackage.

    The layer ``footprints`` is in the CRS of the first target that has one; what was placed in another is
    brought there. Outlines in targets without a CRS have a layer of their own, ``footprints_local``.

    Args:
        path: the file; one that is there is replaced.
        rows: of the batch; those that were not placed are left out.

    Returns:
        The file.

    Raises:
        OutputError: if it cannot be written.

    """
    from pyproj import CRS

    from mtpcr_geo.export.geopackage import write_geopackage

    placed = [row for row in rows if row.footprint and row.crs]
    local = [row for row in rows if row.footprint and not row.crs]
    crs = CRS.from_wkt(placed[0].crs) if placed else None
    layers = []
    if placed or not local:
        layers.append(_layer("footprints", placed, crs))
    if local:
        layers.append(_layer("footprints_local", local, None))
    part = path.with_name(f".{path.stem}.part-{os.getpid()}{path.suffix}")
    try:
        write_geopackage(part, layers, crs)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _layer(name: str, rows: Sequence[Row], crs: CRS | None) -> Layer:
    """Return outlines with what the table says of them, in a CRS; or local, each in its target's frame."""
    from mtpcr_geo.export.geopackage import Layer

    fields = {
        field: np.array([getattr(row, field) for row in rows], np.str_)
        for field in ("name", "verdict", "source", "target", "reason", "folder")
    } | {
        field: np.array([np.nan if getattr(row, field) is None else getattr(row, field) for row in rows])
        for field in ("probability", "margin", "null_ratio", "yaw_deg", "sigma_plan_m", "seconds")
    }
    outlines = [_in_crs(row, crs) for row in rows]
    about = "outlines of the sources where they were placed"
    if crs is None and rows:
        about = f"{about}, in the coordinates of targets without a CRS"
    return Layer(name, "POLYGON", outlines, fields, about, local=crs is None)


def _in_crs(row: Row, crs: CRS | None) -> Floats:
    from pyproj import Transformer

    ring = np.array(row.footprint).reshape(-1, 2)
    if crs is None or row.crs == crs.to_wkt():
        return ring
    moved = Transformer.from_crs(row.crs, crs, always_xy=True).transform(ring[:, 0], ring[:, 1])
    return np.column_stack(moved)

"""Building a survey: each tile rasterised once, each block merged from the tiles that reach it.

What a tile gives to each block is kept beside the mosaic, so that a block is merged again without reading the
points of tiles that have not changed. Every file is written under a temporary name and renamed: a build that
is killed goes on where it stopped, and gives the same bits.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

import numpy as np

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import CrsError, InputError, MtpcrError, OptionError, OutputError
from mtpcr_geo.core.paths import link_among, short
from mtpcr_geo.core.progress import NoProgress, Progress
from mtpcr_geo.core.types import Bev
from mtpcr_geo.crs.facts import facts_of, same_place
from mtpcr_geo.crs.resolve import parse_crs
from mtpcr_geo.io.formats import files_at, open_any
from mtpcr_geo.io.no_returns import NoReturns, without
from mtpcr_geo.method.bev import MAX_CELLS, choose_cell
from mtpcr_geo.survey import is_survey
from mtpcr_geo.survey.engine import SAME_PATHS, engine_of
from mtpcr_geo.survey.index import (
    INDEX,
    PLACE,
    Survey,
    Tile,
    date_of,
    dimensions_of,
    read_frame,
    write_atomic,
    write_frame,
)
from mtpcr_geo.survey.mosaic import BLOCK_CELLS, BLOCKS, BlockRasteriser, Frame, Mosaic, Place, merge
from mtpcr_geo.survey.options import BuildOptions
from mtpcr_geo.survey.vrt import write_virtual

if TYPE_CHECKING:
    from pyproj import CRS

MOST_BLOCKS = MAX_CELLS // BLOCK_CELLS**2
DEFAULTS = BuildOptions()
_PARTS = "tiles"
SOME_TILES = 20


@dataclass(frozen=True)
class Built:
    """What a build did.

    Attributes:
        survey: the survey as it is now.
        read: tiles whose points were read.
        merged: blocks that were written.
        failed: tiles that could not be used, and why.
        gone: tiles that stay in the survey, were not named now, and whose files are no longer there.

    """

    survey: Survey
    read: int
    merged: int
    failed: dict[Path, str]
    gone: tuple[Path, ...] = ()


@dataclass(frozen=True)
class _Reading:
    """A tile to be rasterised."""

    folder: Path
    frame: Frame
    tile: Tile
    crs: str | None


@dataclass(frozen=True)
class _Merging:
    """A block to be merged."""

    mosaic: Mosaic
    place: Place
    tiles: tuple[Tile, ...]

    @property
    def sources(self) -> str:
        return "\n".join(tile.state for tile in self.tiles)


def build_survey(
    tiles: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    options: BuildOptions = DEFAULTS,
    progress: Progress | None = None,
) -> Built:
    """Build a survey of tiles, or bring one up to date: only new and changed tiles are read.

    Args:
        tiles: files, folders, patterns, lists or virtual point clouds; all in one projected CRS.
        folder: of the survey; made if it is not there.
        options: of the build.
        progress: receives the progress.

    Returns:
        The survey. Tiles that could not be used are left out and named, and do not stop the others.

    Raises:
        InputError: if no tile can be used.
        CrsError: if the tiles have no projected CRS.
        OptionError: if an option does not go with an existing survey.
        OutputError: if the folder holds something else, cannot be written, or is another one on the workers.
        MissingPartError: if more than one worker is wanted and Dask is not installed.

    """
    # workers may run in other folders, and on other machines
    folder = Path(folder).absolute()
    progress = progress or NoProgress()
    named = [Tile.at(path) for name in tiles for path in files_at(Path(name))]
    named = list({tile.path: tile for tile in named}.values())
    if not named:
        raise InputError("no tile is named; give files, a folder or a pattern")
    _refuse_links(folder)
    frame = _frame(folder, named, options)
    kept = _earlier(folder, frame)
    gone: list[Tile] = []
    if not options.prune:
        others, gone = _not_named(named, kept)
        named += [*others, *gone]
    wanted = [tile for tile in named if not _is_read(kept.get(tile.path), tile, folder)]
    failed: dict[Path, str] = {}
    done = {tile.path: kept[tile.path] for tile in named if tile not in wanted}
    with engine_of(options, max(len(named), 1)) as engine:
        jobs = [_Reading(folder, frame, tile, options.crs) for tile in wanted]
        with progress.task("rasterising tiles", len(jobs)) as advance:
            for outcome in engine.run(_rasterise, jobs):
                if outcome.made is None:
                    failed[outcome.item.tile.path] = outcome.error or ""
                else:
                    done[outcome.item.tile.path] = outcome.made
                advance(1)
        if not done:
            path, why = next(iter(failed.items()))
            raise InputError(f"none of the {len(named)} tiles can be used; the first, {path}: {why}")
        _refuse_elsewhere(folder, [_part_of(folder, tile) for tile in done.values()], _parts_in(folder))
        survey = Survey(folder, frame).with_tiles(done.values())
        blocks = survey.blocks()
        merging = [_Merging(survey.mosaic, place, tuple(some)) for place, some in blocks.items()]
        stale = [one for one in merging if survey.mosaic.sources_of(one.place) != one.sources]
        with progress.task("merging blocks", len(stale)) as advance:
            for merged in engine.run(_merge, stale):
                if merged.error is not None:
                    raise OutputError(f"block {merged.item.place} cannot be made: {merged.error}")
                advance(1)
    there = survey.mosaic.places()
    mosaic_of = survey.mosaic.path_of
    _refuse_elsewhere(folder, map(mosaic_of, blocks), map(mosaic_of, there))
    for place in there:
        if place not in blocks:
            survey.mosaic.remove(place)
    write_virtual(survey.mosaic, list(blocks))
    survey.write_index()
    _remove_parts(survey)
    missing = tuple(tile.path for tile in gone if tile.path in done)
    return Built(survey, len(wanted) - len(failed), len(stale), failed, missing)


def _not_named(named: Sequence[Tile], kept: Mapping[Path, Tile]) -> tuple[list[Tile], list[Tile]]:
    """Return the tiles of a survey that are not named now, as they are: those there, and those gone."""
    there: list[Tile] = []
    gone: list[Tile] = []
    for path in sorted(kept.keys() - {tile.path for tile in named}):
        try:
            there.append(Tile.at(path))
        except InputError:
            gone.append(kept[path])
    return there, gone


def _refuse_links(folder: Path) -> None:
    """Refuse a survey whose inner folders lead elsewhere: what is stale there is removed.

    Raises:
        OutputError: naming the link.

    """
    link = link_among([folder / _PARTS, folder / BLOCKS, *sorted((folder / BLOCKS).glob("x*"))])
    if link is not None:
        raise OutputError(
            f"{short(link)} is a link, and a survey keeps its files in its own folder; remove it"
        )


def _refuse_elsewhere(folder: Path, wanted: Iterable[Path], found: Iterable[Path]) -> None:
    """Refuse to go on where files that were written are not there, as workers see another folder.

    Raises:
        OutputError: naming the first.

    """
    there = set(found)
    missing = [path for path in wanted if path not in there]
    if missing:
        raise OutputError(
            f"{len(missing)} files of the survey, such as {short(missing[0].relative_to(folder))}, were "
            f"written to another {short(folder)} than is here; {SAME_PATHS}"
        )


def _frame(folder: Path, tiles: Sequence[Tile], options: BuildOptions) -> Frame:
    """Return the cells of the survey that is there, or choose them for a new one."""
    if is_survey(folder):
        frame = read_frame(folder)
        if options.cell is not None and options.cell != frame.cell_m:
            raise OptionError(
                f"the survey {folder} has cells of {frame.cell_m:g} m; leave --cell out, or build another one"
            )
        if options.crs is not None:
            _check_crs(options.crs, frame, f"--crs {options.crs}")
        return frame
    if os.path.exists(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} is there already, and is no survey; name another folder")
    heads = _heads(tiles)
    crs = heads[0].crs if options.crs is None else parse_crs(options.crs)
    if crs is None:
        problem = getattr(heads[0], "crs_problem", "") or "it states none"
        raise CrsError(f"{heads[0].name} has no CRS ({problem}), and a survey needs one; give --crs EPSG:...")
    facts = facts_of(crs)
    if facts.kind != "projected" or facts.horizontal is None:
        raise CrsError(
            f"a survey needs tiles in a projected CRS, and these are in {facts.name}; reproject them first"
        )
    # where nothing is said of heights, not even their unit, the CRS in plan is all there is
    plain = facts.height == "unsaid" and not facts.height_unit_stated
    wkt = facts.horizontal.to_wkt() if plain else crs.to_wkt()
    cell = options.cell
    if cell is None:
        boxes = [np.maximum(head.maximum[:2] - head.minimum[:2], 1.0) * facts.unit for head in heads]
        known = [
            head.count / float(np.prod(box))
            for head, box in zip(heads, boxes, strict=True)
            if head.count and np.isfinite(box).all()
        ]
        cell = choose_cell([float(np.median(known)) if known else 1.0])
    frame = Frame(wkt, float(cell), facts.unit, facts.height_unit)
    write_frame(folder, frame)
    return frame


def _heads(tiles: Sequence[Tile]) -> list[Cloud]:
    """Open some tiles, which tell CRS and density: all of a country would take an hour.

    Raises:
        InputError: if none can be opened.

    """
    heads: list[Cloud] = []
    problem: MtpcrError | None = None
    for tile in tiles[:: max(1, len(tiles) // SOME_TILES)]:
        try:
            heads.append(open_any(tile.path))
        except InputError as error:
            problem = error
    if not heads:
        raise InputError(f"no tile can be opened: {problem}")
    return heads


def _check_crs(claimed: str, frame: Frame, what: str) -> None:
    crs = parse_crs(claimed)
    if crs is None:
        raise CrsError(
            f"{what} is local coordinates, and the survey is in {frame.crs.name}; reproject it first"
        )
    if not same_place(crs, frame.crs):
        name, own = _told_apart(crs, frame.crs)
        raise CrsError(f"{what} is {name}, and the survey is in {own}; reproject it first")


def _told_apart(one: CRS, other: CRS) -> tuple[str, str]:
    """Return names of two CRSs that are not one; with heights and their units where they are one in plan."""
    first, second = facts_of(one), facts_of(other)
    plans = (first.horizontal, second.horizontal)
    if plans[0] is None or plans[1] is None or not same_place(plans[0], plans[1]):
        return str(one.name), str(other.name)
    heights = (f" with {facts.height_name} in {facts.height_unit_name}" for facts in (first, second))
    return f"{plans[0].name}{next(heights)}", f"{plans[1].name}{next(heights)}"


def _earlier(folder: Path, frame: Frame) -> dict[Path, Tile]:
    """Return the tiles of the survey as it is, and those that a stopped build had read beyond it."""
    found: dict[Path, Tile] = {}
    if (folder / INDEX).is_file():
        found = {tile.path: tile for tile in Survey.open(folder).tiles}
    for path in sorted(_parts_in(folder)):
        tile = _tile_in(path)
        if tile is not None:
            found[tile.path] = tile
    return found


def _is_read(known: Tile | None, tile: Tile, folder: Path) -> bool:
    return known is not None and known.state == tile.state and _part_of(folder, tile).is_file()


def _parts_in(folder: Path) -> Iterator[Path]:
    return (folder / _PARTS).glob("*.npz")


def _part_of(folder: Path, tile: Tile) -> Path:
    return folder / _PARTS / f"{tile.id}.npz"


def _rasterise(job: _Reading) -> Tile:
    """Rasterise a tile into blocks, and keep them beside the mosaic."""
    cloud = open_any(job.tile.path, None if job.crs is None else parse_crs(job.crs))
    if cloud.crs is None:
        problem = getattr(cloud, "crs_problem", "") or "it states none"
        raise CrsError(f"it has no CRS ({problem}); give --crs")
    if not same_place(cloud.crs, job.frame.crs):
        name, own = _told_apart(cloud.crs, job.frame.crs)
        raise CrsError(f"it is in {name}, and the survey in {own}; reproject it first")
    blocks = BlockRasteriser(job.frame, MOST_BLOCKS, cloud.name)
    low, high, used = np.full(3, np.inf), np.full(3, -np.inf), 0
    none = NoReturns(0)
    for xyz, noise in cloud.noise_chunks():
        good = xyz[~noise]
        none.look(good)
        good = without(good, none.places)
        if not np.isfinite(good).all():
            raise InputError(f"{cloud.name} has coordinates that are not finite; remove those points")
        if len(good):
            used += len(good)
            low, high = np.minimum(low, good.min(axis=0)), np.maximum(high, good.max(axis=0))
            blocks.add(job.frame.metric(good))
    made = blocks.finish()
    bounds = tuple(float(value) for value in (*low, *high)) if used else (0.0,) * 6
    tile = replace(
        job.tile,
        points=cloud.count,
        used=used,
        bounds=bounds,
        blocks=tuple(made),
        date=date_of(cloud),
        dimensions=dimensions_of(cloud),
    )
    if not job.tile.unchanged():
        raise InputError(f"{tile.path} changed while it was read; run survey build again")
    _write_part(_part_of(job.folder, tile), tile, made)
    return tile


def _merge(job: _Merging) -> None:
    parts = [_read_part(_part_of(job.mosaic.folder, tile), job.place, job.mosaic.frame) for tile in job.tiles]
    job.mosaic.write(job.place, merge(parts), job.sources)


def _write_part(path: Path, tile: Tile, blocks: dict[Place, Bev]) -> None:
    """Write what a tile gives to each block, cut to the rows and columns that it fills."""
    arrays: dict[str, np.ndarray] = {
        "path": np.array(str(tile.path)),
        "numbers": np.array([tile.size, tile.modified_ns, tile.points, tile.used], np.int64),
        "bounds": np.array(tile.bounds),
        "blocks": np.array(tile.blocks, np.int64).reshape(-1, 2),
        "date": np.array(tile.date or ""),
        "dimensions": np.array(json.dumps(tile.dimensions)),
    }
    for (column, row), bev in blocks.items():
        filled = bev.count > 0
        rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
        cut = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        name = f"{column}_{row}"
        arrays[f"{name}_at"] = np.array([rows[0], columns[0]], np.int64)
        arrays[f"{name}_top"], arrays[f"{name}_low"] = bev.top[cut], bev.low[cut]
        arrays[f"{name}_count"] = bev.count[cut]
    held = io.BytesIO()
    np.savez_compressed(held, **arrays)  # type: ignore[arg-type]
    write_atomic(path, held.getvalue())


def _read_part(path: Path, place: Place, frame: Frame) -> Bev:
    grid = frame.grid_of(place)
    top = np.full(grid.shape, np.nan, np.float32)
    low = top.copy()
    count = np.zeros(grid.shape, np.uint32)
    name = f"{place[0]}_{place[1]}"
    try:
        with np.load(path, allow_pickle=False) as held:
            row, column = held[f"{name}_at"]
            height, width = held[f"{name}_count"].shape
            cut = (slice(row, row + height), slice(column, column + width))
            top[cut], low[cut] = held[f"{name}_top"], held[f"{name}_low"]
            count[cut] = held[f"{name}_count"]
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise InputError(f"{path} is damaged ({error}); remove it, and run survey build again") from error
    return Bev(grid, top, low, count)


def _tile_in(path: Path) -> Tile | None:
    """Return the tile that a kept part is of; None if it cannot be read, so that it is made anew."""
    try:
        with np.load(path, allow_pickle=False) as held:
            size, modified, points, used = (int(value) for value in held["numbers"])
            bounds = tuple(float(value) for value in held["bounds"])
            blocks = tuple((int(c), int(r)) for c, r in held["blocks"])
            # builds of earlier versions did not keep them
            kept = json.loads(str(held["dimensions"])) if "dimensions" in held else ()
            return Tile(
                Path(str(held["path"])),
                size,
                modified,
                points,
                used,
                bounds,
                blocks,
                str(held["date"]) or None,
                tuple((str(name), str(kind), int(size)) for name, kind, size in kept) or PLACE,
            )
    except (OSError, ValueError, KeyError, TypeError, RecursionError, BadZipFile):
        return None


def _remove_parts(survey: Survey) -> None:
    """Remove what is kept of tiles that are no longer part of the survey, and what killed builds left."""
    known = {_part_of(survey.folder, tile).name for tile in survey.tiles}
    for folder, pattern in ((survey.folder / _PARTS, "*"), (survey.folder / BLOCKS, "x*/.*")):
        for path in folder.glob(pattern):
            if path.name not in known:
                path.unlink(missing_ok=True)

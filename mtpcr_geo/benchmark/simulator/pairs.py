"""Simulated ground-to-aerial pairs with a known transform.

    pair = simulate_pair("town", seed=1)
    write_pair(Path("town_1"), pair)

A site is made from its seed (`site`), scanned on the ground in one epoch and from the air in
another (`scanners`), and the ground cloud is turned, tilted and shifted. The same seed and
options give the same clouds, bit for bit, on one machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.pairs import write_folder
from mtpcr_geo.benchmark.simulator import instruments, scanners
from mtpcr_geo.benchmark.simulator.kinds import KINDS, STYLES, Kind
from mtpcr_geo.benchmark.simulator.options import PairOptions, pair_options
from mtpcr_geo.benchmark.simulator.overlap import near_shares, occupied_cells, place_block
from mtpcr_geo.benchmark.simulator.raycast import Caster
from mtpcr_geo.benchmark.simulator.scanners import Block
from mtpcr_geo.benchmark.simulator.site import MARGIN_M, Site, make_site
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.voxels import first_in_voxels

__all__ = [
    "KINDS",
    "Kind",
    "NothingSeenError",
    "SimulatedPair",
    "describe",
    "simulate_from",
    "simulate_pair",
    "write_pair",
]

TARGET_EPSG = 25832


class NothingSeenError(OptionError):
    """With these options one of the scans sees nothing of the site."""


# parts of the ground scan (of its time) tried in turn until the shares come out as asked
_SHORTER = (
    (0.0, 1.0),
    (0.15, 1.0),
    (0.3, 1.0),
    (0.0, 0.8),
    (0.2, 0.85),
    (0.45, 1.0),
    (0.0, 0.6),
    (0.3, 0.75),
)


@dataclass(frozen=True)
class SimulatedPair:
    """Two clouds of one site and the truth between them.

    Attributes:
        name: such as "town_1".
        kind: the kind of site.
        source: the ground cloud in a local frame of its own (metres, no CRS).
        target: the aerial cloud in its projected CRS.
        T_target_source: 4x4 float64, source coordinates to target coordinates.
        overlap_source: share of the source's occupied 1 m cells (true pose, seen from above) that lie
            within one cell of an occupied cell of the target.
        overlap_target: the same the other way round.
        description: of the site and the scanners.
        options: what it was made with.

    """

    name: str
    kind: Kind
    source: ArrayCloud
    target: ArrayCloud
    T_target_source: Floats
    overlap_source: float
    overlap_target: float
    description: str
    options: dict[str, Any]


def simulate_pair(kind: Kind, seed: int = 0, **options: Any) -> SimulatedPair:
    """Make a site and scan it from the ground and from the air.

    Args:
        kind: one of `KINDS`.
        seed: of everything: site, scanners, noise, transform.
        options: further fields of `PairOptions`.

    Raises:
        OptionError: if an option is unknown or out of its range.
        NothingSeenError: if one of the scans sees nothing.
        MissingPartError: if ``embreex`` is not installed.

    """
    return simulate_from(pair_options(kind=kind, seed=seed, **options))


def simulate_from(options: PairOptions) -> SimulatedPair:
    """Make the pair of a set of options; see `simulate_pair`."""
    kind, seed = options.kind, options.seed
    site = make_site(kind, seed, options.extent_m)
    chance = np.random.default_rng([seed, 23])
    yaw = float(chance.uniform(-0.2, 0.2))
    path = walk_through(site, yaw)
    caster = Caster(site.mesh(0, options.ground_leaves))
    if options.ground == "robot":
        beams = scanners.robot_beams(
            path, site.ground.height, options.ground_beams, chance, drift_m=options.drift_m
        )
        low = instruments.measure(caster, beams, instruments.ROBOT, chance)
    else:
        stops = path[:: max(1, len(path) // max(3, int(options.extent_m / 40)))]
        beams = scanners.tripod_beams(stops, site.ground.height, options.ground_beams, chance)
        low = instruments.measure(caster, beams, instruments.TRIPOD, chance)
    low = low.part(np.abs(low.xyz[:, :2]).max(axis=1) < site.half + MARGIN_M - 2.0)
    if options.voxel_m > 0:
        low = low.part(first_in_voxels(low.xyz, options.voxel_m))
    if not low.extra["GpsTime"].size:
        raise NothingSeenError(
            f"the ground scan of {kind} {seed} saw nothing; send more beams than {options.ground_beams}"
        )

    low, block, path = shared_block(low, path, site, yaw, (options.overlap, options.overlap))
    if options.epochs_apart or options.air_leaves != options.ground_leaves:
        caster = Caster(site.mesh(options.epochs_apart, options.air_leaves))
    fly = scanners.airborne_beams if options.air == "airborne" else scanners.uav_beams
    how = instruments.AIRBORNE if options.air == "airborne" else instruments.UAV
    high = instruments.measure(
        caster, fly(block, site.ground.height, options.air_density, chance), how, chance
    )
    high = high.part(block.contains(high.xyz[:, :2]))
    if not high.extra["GpsTime"].size:
        raise NothingSeenError(
            f"the aerial scan of {kind} {seed} saw nothing; take a larger overlap than {options.overlap:g}"
        )

    T_target_site, T_source_site = _frames(path, site, options.tilt_deg, np.random.default_rng([seed, 29]))
    shares = near_shares(occupied_cells(low.xyz), occupied_cells(high.xyz))
    from pyproj import CRS

    made = options.model_dump(mode="json") | {"path_m": round(scanners.path_length(path), 1)}
    return SimulatedPair(
        name=f"{kind}_{seed}",
        kind=kind,
        source=ArrayCloud(transforms.apply(T_source_site, low.xyz), None, "ground", dict(low.extra)),
        target=ArrayCloud(
            transforms.apply(T_target_site, high.xyz), CRS.from_epsg(TARGET_EPSG), "aerial", dict(high.extra)
        ),
        T_target_source=T_target_site @ transforms.inverse(T_source_site),
        overlap_source=shares[0],
        overlap_target=shares[1],
        description=(
            f"simulated {STYLES[kind].description}; {options.ground} on the ground, {options.air} above"
        ),
        options=made,
    )


def walk_through(site: Site, yaw: float) -> Floats:
    """Return the robot's way: through the quarter at the -x end, then on towards the +x end."""
    nodes = site.roads.nodes
    c, s = np.cos(yaw), np.sin(yaw)
    u, v = (nodes @ np.array([[c, -s], [s, c]])).T
    near = np.abs(nodes).max(axis=1) < site.half - 5.0
    pool = np.flatnonzero(near) if near.sum() >= 2 else np.arange(len(nodes))
    start = int(pool[np.argmin(u[pool])])
    end = int(pool[np.argmin(np.hypot(u[pool] - 0.35 * site.half, 0.5 * v[pool]))])
    allowed = near & (u < 0.15 * site.half)
    path = site.roads.walk(allowed, start, end, 3.4 * site.half)
    if scanners.path_length(path) < 20.0:
        line = max(site.roads.lines, key=len)
        return line
    return path


def shared_block(
    low: instruments.Scan, path: Floats, site: Site, yaw: float, shares: tuple[float, float]
) -> tuple[instruments.Scan, Block, Floats]:
    """Find the block to fly over; a ground scan too large for the site is shortened at its ends.

    Args:
        low: the ground scan.
        path: (k, 2) its way, metres.
        site: what is scanned.
        yaw: turn of the block, radians.
        shares: of the ground cloud and of the aerial cloud that shall be shared.

    """
    time = np.asarray(low.extra["GpsTime"], np.float64)
    best: tuple[float, instruments.Scan, Block, Floats] | None = None
    for first, last in _SHORTER:
        part = low.part((time >= first * time.max()) & (time <= last * time.max()))
        if not len(part.xyz):
            continue
        block, gap = place_block(occupied_cells(part.xyz), site.half, yaw, *shares)
        if best is None or gap < best[0]:
            best = gap, part, block, path[int(first * len(path)) : max(2, int(last * len(path)))]
        if gap < 0.125 * sum(shares):
            break
    assert best is not None
    return best[1:]


def _frames(path: Floats, site: Site, tilt_deg: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Draw the target's frame (a far CRS, turned) and the source's (at the robot's start, not level)."""
    far = np.array(
        [rng.uniform(420_000, 640_000), rng.uniform(5_300_000, 6_050_000), rng.uniform(15, 600)]
    ).round(2)
    T_target_site = transforms.compose(transforms.yaw_matrix(rng.uniform(0, 2 * np.pi)), far)
    start = np.array([*path[0], float(site.ground.height(path[:1])[0]) + 1.3])
    R = transforms.tilt_matrix(rng.uniform(0, 2 * np.pi), np.deg2rad(tilt_deg)) @ transforms.yaw_matrix(
        rng.uniform(0, 2 * np.pi)
    )
    shift = np.array([*rng.uniform(-100, 100, 2), rng.uniform(-20, 20)])
    return T_target_site, transforms.compose(R, shift - R @ start)


def write_pair(folder: Path, pair: SimulatedPair, *, overwrite: bool = False) -> list[Path]:
    """Write ``source.laz``, ``target.laz`` (LAS 1.4, point format 6) and ``pair.json``.

    Args:
        folder: where to; made if missing.
        pair: what to write.
        overwrite: whether files there may be replaced.

    Returns:
        The paths written.

    Raises:
        OutputError: if a file exists already or the folder cannot be written.

    """
    return write_folder(Path(folder), pair.source, pair.target, describe(pair), overwrite=overwrite)


def describe(pair: SimulatedPair, names: tuple[str, str] = ("source.laz", "target.laz")) -> dict[str, Any]:
    """Return the content of ``pair.json``: CRS, truth, overlap, both clouds by file name, options."""
    crs = pair.target.crs
    return {
        "id": pair.name,
        "kind": pair.description,
        "crs": f"target EPSG:{crs.to_epsg()}, source local (metres)" if crs is not None else "local",
        "ground_truth": {
            "T_target_from_source": pair.T_target_source.tolist(),
            "kind": "exact: source file coordinates to target file coordinates, metres",
        },
        "overlap": {
            "cell_m": 1.0,
            "source_cells_near_target": round(pair.overlap_source, 4),
            "target_cells_near_source": round(pair.overlap_target, 4),
            "note": "share of occupied 1 m cells with one of the other among it and its 8 neighbours",
        },
        "source": _cloud_facts(names[0], pair.source),
        "target": _cloud_facts(names[1], pair.target),
        "simulation": pair.options,
    }


def _cloud_facts(file: str, cloud: ArrayCloud) -> dict[str, Any]:
    return {
        "file": file,
        "points": cloud.count,
        "min": cloud.minimum.round(3).tolist(),
        "max": cloud.maximum.round(3).tolist(),
        "extent_m": (cloud.maximum - cloud.minimum).round(1).tolist(),
        "centroid": cloud.xyz.mean(axis=0).round(3).tolist(),
    }

"""Simulated ground-to-aerial pairs with a known transform.

    pair = simulate_pair("town", seed=1)
    write_pair(Path("town_1"), pair)

A site is made from its seed (`sim.site`), scanned on the ground in one epoch and from the air in
another (`sim.scanners`), and the ground cloud is turned, tilted and shifted. The same seed and
options give the same clouds, bit for bit, on one machine.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from mtpcr_geo.benchmark.simulator import instruments, scanners
from mtpcr_geo.benchmark.simulator.kinds import KINDS, STYLES, Kind
from mtpcr_geo.benchmark.simulator.overlap import near_shares, occupied_cells, place_block
from mtpcr_geo.benchmark.simulator.raycast import Caster
from mtpcr_geo.benchmark.simulator.scanners import Block
from mtpcr_geo.benchmark.simulator.site import MARGIN_M, Site, make_site
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.io.outputs import OutputSet

__all__ = ["KINDS", "Kind", "SimulatedPair", "describe", "simulate_pair", "write_laz", "write_pair"]

Ground = Literal["robot", "tripod"]
Air = Literal["airborne", "uav"]
TARGET_EPSG = 25832
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
        description: in words.
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


def simulate_pair(
    kind: Kind,
    seed: int = 0,
    *,
    extent_m: float = 400.0,
    overlap: float = 0.18,
    tilt_deg: float = 5.0,
    ground: Ground = "robot",
    air: Air = "airborne",
    air_density: float = 6.0,
    ground_beams: int = 2_000_000,
    voxel_m: float = 0.12,
    drift_m: float = 0.04,
    leafiness: tuple[float, float] = (1.0, 1.0),
    epochs_apart: int = 1,
) -> SimulatedPair:
    """Make a site and scan it from the ground and from the air.

    Args:
        kind: one of `KINDS`.
        seed: chance of everything: site, scanners, noise, transform.
        extent_m: edge of the site's square, metres (100 to 1500).
        overlap: share aimed at, on both sides; what came out is in the pair.
        tilt_deg: by how much the ground cloud's frame is off level, degrees (about any level axis).
        ground: "robot" (spinning lidar driven along roads) or "tripod" (static set-ups along them).
        air: "airborne" (line scanner, two flight lines) or "uav" (spinning lidar, 70 m up).
        air_density: pulses per square metre.
        ground_beams: beams sent from the ground, in all.
        voxel_m: the ground cloud is thinned to a point per voxel of this edge, as maps are; 0 keeps all.
        drift_m: standard deviation of the robot's error of place, metres.
        leafiness: share of leaves on the trees, on the ground's and the air's day (winter: 0.25).
        epochs_apart: 0 for one epoch, 1 or more for plants, crops and cars that differ.

    Raises:
        OptionError: if an option is out of its range.
        MissingPartError: if Open3D cannot be loaded.

    """
    _check(kind, extent_m, overlap, air_density, ground, air)
    site = make_site(kind, seed, extent_m)
    chance = np.random.default_rng([seed, 23])
    yaw = float(chance.uniform(-0.2, 0.2))
    path = walk_through(site, yaw)
    caster = Caster(site.mesh(0, leafiness[0]))
    if ground == "robot":
        beams = scanners.robot_beams(path, site.ground.height, ground_beams, chance, drift_m=drift_m)
        low = instruments.measure(caster, beams, instruments.ROBOT, chance)
    else:
        stops = path[:: max(1, len(path) // max(3, int(extent_m / 40)))]
        beams = scanners.tripod_beams(stops, site.ground.height, ground_beams, chance)
        low = instruments.measure(caster, beams, instruments.TRIPOD, chance)
    low = low.part(np.abs(low.xyz[:, :2]).max(axis=1) < site.half + MARGIN_M - 2.0)
    low = low.part(thinned(low.xyz, voxel_m))
    if not low.extra["GpsTime"].size:
        raise OptionError(
            f"the ground scan of {kind} {seed} saw nothing; send more beams than {ground_beams}"
        )

    low, block, path = shared_block(low, path, site, yaw, (overlap, overlap))
    if epochs_apart or leafiness[1] != leafiness[0]:
        caster = Caster(site.mesh(epochs_apart, leafiness[1]))
    fly = scanners.airborne_beams if air == "airborne" else scanners.uav_beams
    how = instruments.AIRBORNE if air == "airborne" else instruments.UAV
    high = instruments.measure(caster, fly(block, site.ground.height, air_density, chance), how, chance)
    high = high.part(block.contains(high.xyz[:, :2]))

    T_target_site, T_source_site = _frames(path, site, tilt_deg, np.random.default_rng([seed, 29]))
    shares = near_shares(occupied_cells(low.xyz), occupied_cells(high.xyz))
    from pyproj import CRS

    options = {
        "kind": kind, "seed": seed, "extent_m": extent_m, "overlap": overlap, "tilt_deg": tilt_deg,
        "ground": ground, "air": air, "air_density": air_density, "ground_beams": ground_beams,
        "voxel_m": voxel_m, "drift_m": drift_m, "leafiness": list(leafiness), "epochs_apart": epochs_apart,
        "path_m": round(scanners.path_length(path), 1),
    }  # fmt: skip
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
        description=f"simulated {STYLES[kind].description}; {ground} on the ground, {air} above",
        options=options,
    )


def _check(kind: str, extent_m: float, overlap: float, density: float, ground: str, air: str) -> None:
    for name, value, allowed in (
        ("kind", kind, KINDS),
        ("ground", ground, get_args(Ground)),
        ("air", air, get_args(Air)),
    ):
        if value not in allowed:
            raise OptionError(f"no {name} {value!r} to simulate; choose one of {', '.join(allowed)}")
    for name, number, low, high in (
        ("extent_m", extent_m, 100.0, 1500.0),
        ("overlap", overlap, 0.01, 0.8),
        ("air_density", density, 0.1, 200.0),
    ):
        if not low <= number <= high:
            raise OptionError(f"{name} is {number:g}; it must lie between {low:g} and {high:g}")


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


def thinned(xyz: Floats, voxel: float) -> Indices:
    """Return the numbers of the first points of each voxel, in their old order."""
    if voxel <= 0:
        return np.arange(len(xyz))
    cell = np.floor((xyz - xyz.min(axis=0)) / voxel).astype(np.int64)
    size = cell.max(axis=0) + 1
    _, first = np.unique((cell[:, 2] * size[1] + cell[:, 1]) * size[0] + cell[:, 0], return_index=True)
    return np.sort(first)


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
    folder = Path(folder)
    with OutputSet(overwrite) as out:
        for name, cloud in (("source.laz", pair.source), ("target.laz", pair.target)):
            write_laz(out.path(folder / name), cloud)
        out.path(folder / "pair.json").write_text(json.dumps(describe(pair), indent=1) + "\n", "utf-8")
        return out.commit()


def write_laz(path: Path, cloud: ArrayCloud) -> None:
    """Write a cloud held in memory as LAS 1.4 point format 6, scale 0.001, with its CRS as WKT."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(cloud.minimum) if cloud.count else np.zeros(3)
    header.global_encoding.wkt = True
    if cloud.crs is not None:
        header.add_crs(cloud.crs)
    las = laspy.LasData(header)
    las.xyz = cloud.xyz
    for ours, theirs in (
        ("Intensity", "intensity"),
        ("ReturnNumber", "return_number"),
        ("NumberOfReturns", "number_of_returns"),
        ("Classification", "classification"),
        ("GpsTime", "gps_time"),
    ):
        if ours in cloud.extra:
            las[theirs] = cloud.extra[ours]
    las.write(str(path))


def describe(pair: SimulatedPair, names: tuple[str, str] = ("source.laz", "target.laz")) -> dict[str, Any]:
    """Return what ``pair.json`` says: CRS, truth, overlap, the two clouds by file name, how it was made."""
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
    }

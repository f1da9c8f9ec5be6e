"""Stand-ins for the paper's fourteen combinations: simulated sites with its extents and overlaps.

They are no GrAco. A spinning lidar on a ground robot (G) and one under a UAV (A) scan a simulated site
whose edge is the paper's extent (Table I), so that the overlaps come near the paper's. For the nine
combinations for which the paper gives neither, the means of those of the same group are taken. Heights are
those of the simulated kinds of site, 28 to 43 m from lowest to highest, where the paper's go up
to 59 m; what came out stands in each ``pair.json``. Every name begins with ``standin_``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.pairs import write_folder
from mtpcr_geo.benchmark.published import COMBINATIONS, TABLE_I, Combination, Extent
from mtpcr_geo.benchmark.simulator import instruments, scanners
from mtpcr_geo.benchmark.simulator.instruments import Scan
from mtpcr_geo.benchmark.simulator.kinds import STYLES, Kind
from mtpcr_geo.benchmark.simulator.overlap import near_shares, occupied_cells
from mtpcr_geo.benchmark.simulator.pairs import (
    SimulatedPair,
    describe,
    shared_block,
    walk_through,
)
from mtpcr_geo.benchmark.simulator.raycast import Caster
from mtpcr_geo.benchmark.simulator.scanners import Block
from mtpcr_geo.benchmark.simulator.site import MARGIN_M, Site, make_site
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.voxels import first_in_voxels

PREFIX = "standin_"
# mostly a campus, as the dataset's site was; other kinds now and then, so that nothing fits one only
KINDS: tuple[Kind, ...] = (
    "campus", "campus", "suburb", "campus", "town", "campus", "rows", "campus",
    "campus", "suburb", "campus",
    "campus", "suburb", "town",
)  # fmt: skip


@dataclass(frozen=True)
class StandIn:
    """What to simulate for a combination.

    Attributes:
        combination: the paper's.
        extent_and_overlap: extent and overlap aimed at.
        given: whether the paper gives them for this combination, or they are means of its group.
        kind: of the site.
        seed: of everything.

    """

    combination: Combination
    extent_and_overlap: Extent
    given: bool
    kind: Kind
    seed: int

    @property
    def name(self) -> str:
        """Such as "standin_A03-G05"."""
        return PREFIX + self.combination.name


def stand_ins(seed: int = 0) -> list[StandIn]:
    """List the fourteen, in the paper's order."""
    out = []
    for number, (combination, kind) in enumerate(zip(COMBINATIONS, KINDS, strict=True)):
        given = TABLE_I.get(combination.name)
        out.append(
            StandIn(combination, given or _typical(combination.group), given is not None, kind, seed + number)
        )
    return out


def write_stand_in(folder: Path, stand_in: StandIn, *, density: float = 1.0) -> Path:
    """Simulate a stand-in into ``folder/standin_...``, or leave what is there from before.

    Args:
        folder: of all stand-ins; made if missing.
        stand_in: which.
        density: share of the usual number of beams; 1 gives a point cloud as dense as a thinned map.

    Returns:
        The pair's folder.

    Raises:
        OptionError: if another stand-in of that name is there, made otherwise.
        OutputError: if the folder cannot be written.

    """
    place = Path(folder) / stand_in.name
    wanted = {"seed": stand_in.seed, "kind": stand_in.kind, "density": density}
    if (place / "pair.json").exists():
        made = json.loads((place / "pair.json").read_text(encoding="utf-8"))["simulation"]
        if {key: made.get(key) for key in wanted} != wanted:
            raise OptionError(f"{place} was made otherwise ({made}); remove it or choose another folder")
        return place
    pair = simulate_stand_in(stand_in, density=density)
    facts = describe(pair) | {
        "benchmark": {
            "group": stand_in.combination.group,
            "source": stand_in.combination.source,
            "target": stand_in.combination.target,
            "stand_in": "simulated, with the paper's extent and overlap; not GrAco",
            "aimed_at": stand_in.extent_and_overlap._asdict(),
            "figures": "the paper's Table I" if stand_in.given else "means of the group's rows in Table I",
        }
    }
    write_folder(place, pair.source, pair.target, facts, overwrite=True)
    return place


def simulate_stand_in(stand_in: StandIn, *, density: float = 1.0) -> SimulatedPair:
    """Simulate a stand-in; both clouds are local, in metres.

    Args:
        stand_in: which.
        density: share of the usual number of beams.

    """
    extent_and_overlap, group = stand_in.extent_and_overlap, stand_in.combination.group
    extent = float(np.clip(np.sqrt(extent_and_overlap.dx_m * extent_and_overlap.dy_m), 100.0, 1500.0))
    site = make_site(stand_in.kind, stand_in.seed, extent)
    chance = np.random.default_rng([stand_in.seed, 31])
    make = {"A-G": _air_ground, "G-G": _ground_ground, "A-A": _air_air}[group]
    source, target = make(site, extent_and_overlap, density, chance)
    shares = near_shares(occupied_cells(source.xyz), occupied_cells(target.xyz))
    # each in a frame of its own, like maps that know nothing of one another
    T_source_site, T_target_site = (
        transforms.compose(transforms.yaw_matrix(chance.uniform(0, 2 * np.pi)), chance.uniform(-200, 200, 3))
        for _ in range(2)
    )
    both = np.vstack([source.xyz, target.xyz])
    options: dict[str, Any] = {
        "kind": stand_in.kind,
        "seed": stand_in.seed,
        "density": density,
        "extent_m": np.ptp(both, axis=0).round(2).tolist(),
    }
    return SimulatedPair(
        name=stand_in.name,
        kind=stand_in.kind,
        source=ArrayCloud(transforms.apply(T_source_site, source.xyz), None, "source", dict(source.extra)),
        target=ArrayCloud(transforms.apply(T_target_site, target.xyz), None, "target", dict(target.extra)),
        T_target_source=T_target_site @ transforms.inverse(T_source_site),
        overlap_source=shares[0],
        overlap_target=shares[1],
        description=f"stand-in for {stand_in.combination.name}: {STYLES[stand_in.kind].description}",
        options=options,
    )


def _typical(group: str) -> Extent:
    """Return the mean of the group's rows in Table I."""
    rows = [
        extent_and_overlap
        for name, extent_and_overlap in TABLE_I.items()
        if "-".join(part[0] for part in name.split("-")) == group
    ]
    return Extent(*np.mean(rows, axis=0).round(2).tolist())


def _air_ground(
    site: Site, extent_and_overlap: Extent, density: float, rng: np.random.Generator
) -> tuple[Scan, Scan]:
    """Fly over a block whose air survey is the source; the robot's drive is the target."""
    yaw = float(rng.uniform(-0.2, 0.2))
    path = walk_through(site, yaw)
    low = _drive(site, path, 0, density, rng)
    shares = extent_and_overlap.overlap_target_pct / 100, extent_and_overlap.overlap_source_pct / 100
    low, block, _ = shared_block(low, path, site, yaw, shares)
    return _fly(site, block, 1, density, rng), low


def _ground_ground(
    site: Site, extent_and_overlap: Extent, density: float, rng: np.random.Generator
) -> tuple[Scan, Scan]:
    """Drive twice, in two epochs, and take the parts of both drives that share as much as asked."""
    path = walk_through(site, float(rng.uniform(-0.2, 0.2)))
    drives = [_drive(site, path, epoch, density, rng) for epoch in (0, 1)]
    ends = [float(np.max(drive.extra["GpsTime"].astype(np.float64))) for drive in drives]
    wanted = np.array([extent_and_overlap.overlap_source_pct, extent_and_overlap.overlap_target_pct]) / 100
    # the cells that a drive has seen by each twentieth of its time, from its start and to its end
    steps = np.linspace(0.05, 1.0, 20)
    first = [occupied_cells(_part(drives[0], 0.0, s * ends[0]).xyz) for s in steps]
    last = [occupied_cells(_part(drives[1], (1 - s) * ends[1], ends[1]).xyz) for s in steps]
    gaps = {
        (i, j): float(np.abs(np.array(near_shares(a, b)) - wanted).sum())
        for i, a in enumerate(first)
        for j, b in enumerate(last)
        if len(a) and len(b)
    }
    i, j = min(gaps, key=lambda key: gaps[key])
    return (
        _part(drives[0], 0.0, steps[i] * ends[0]),
        _part(drives[1], (1 - steps[j]) * ends[1], ends[1]),
    )


def _air_air(
    site: Site, extent_and_overlap: Extent, density: float, rng: np.random.Generator
) -> tuple[Scan, Scan]:
    """Fly two blocks side by side that overlap, in two epochs."""
    first, second = (
        share / 100
        for share in (extent_and_overlap.overlap_source_pct, extent_and_overlap.overlap_target_pct)
    )
    # widths a and b with a shared strip s: s = first a = second b, and a + b - s is the whole site
    a = 2 * site.half / (1 + first / second - first)
    b = a * first / second
    blocks = [
        Block(np.array([-site.half, -site.half]), np.array([-site.half + a, site.half]), 0.0),
        Block(np.array([site.half - b, -site.half]), np.array([site.half, site.half]), 0.0),
    ]
    one, two = (_fly(site, block, epoch, density, rng) for epoch, block in enumerate(blocks))
    return one, two


def _drive(site: Site, path: Floats, epoch: int, density: float, rng: np.random.Generator) -> Scan:
    beams = scanners.robot_beams(path, site.ground.height, int(2_000_000 * density), rng)
    scan = instruments.measure(Caster(site.mesh(epoch)), beams, instruments.ROBOT, rng)
    scan = scan.part(np.abs(scan.xyz[:, :2]).max(axis=1) < site.half + MARGIN_M - 2.0)
    return scan.part(first_in_voxels(scan.xyz, 0.12))


def _fly(site: Site, block: Block, epoch: int, density: float, rng: np.random.Generator) -> Scan:
    beams = scanners.uav_beams(block, site.ground.height, 10.0 * density, rng)
    scan = instruments.measure(Caster(site.mesh(epoch)), beams, instruments.UAV, rng)
    return scan.part(block.contains(scan.xyz[:, :2]))


def _part(scan: Scan, start: float, end: float) -> Scan:
    time = scan.extra["GpsTime"].astype(np.float64)
    return scan.part((time >= start) & (time <= end))

"""Write ten simulated ground-to-aerial pairs of seven kinds of site, with known truth.

    python examples/simulate_pairs.py FOLDER

Extents are 350 to 600 m, 13 to 23 % of either cloud overlaps the other, yaw is any, tilts go to 10 degrees.
`examples/benchmark_pairs.py FOLDER --as-is` then registers them. With ``--low-overlap 28`` it writes so many
upright pairs instead, of all seven kinds in turn: sites of 170 m, 10 to 25 % of either cloud shared, a robot
or a tripod against an airborne scanner or a drone.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mtpcr_geo.benchmark.simulator.pairs import (
    KINDS,
    NothingSeenError,
    SimulatedPair,
    simulate_pair,
    write_pair,
)

# kind, seed, extent in metres, overlap, tilt in degrees, aerial scanner, its points per square metre
SITES = [
    ("town", 1, 400, 0.18, 4.0, "airborne", 6.0),
    ("town", 2, 350, 0.22, 0.0, "uav", 16.0),
    ("town", 3, 500, 0.13, 9.0, "airborne", 4.0),
    ("suburb", 4, 450, 0.18, 6.0, "airborne", 8.0),
    ("suburb", 5, 350, 0.15, 2.0, "uav", 12.0),
    ("campus", 6, 450, 0.16, 10.0, "airborne", 5.0),
    ("forest", 7, 400, 0.20, 3.0, "airborne", 10.0),
    ("farmland", 8, 600, 0.17, 5.0, "airborne", 4.0),
    ("steep", 9, 450, 0.16, 7.0, "airborne", 6.0),
    ("rows", 10, 400, 0.14, 8.0, "airborne", 6.0),
]


def main() -> None:
    """Simulate and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="where to write a folder for each pair")
    parser.add_argument("--first", type=int, default=len(SITES), help="only so many pairs")
    parser.add_argument(
        "--reseed", type=int, default=0, help="add this to every seed: other sites of each kind"
    )
    parser.add_argument(
        "--low-overlap", type=int, default=0, help="so many pairs of little overlap instead of these ten"
    )
    options = parser.parse_args()
    pairs = low_overlap(options.low_overlap, options.reseed) if options.low_overlap else listed(options)
    for pair in pairs:
        write_pair(options.folder / pair.name, pair, overwrite=True)
        print(
            f"{pair.name:14} {pair.source.count:8} / {pair.target.count:8} points, overlap "
            f"{pair.overlap_source:.0%} of the source, {pair.overlap_target:.0%} of the target",
            flush=True,
        )


def listed(options: argparse.Namespace) -> Iterator[SimulatedPair]:
    """Yield the pairs of `SITES`."""
    for kind, seed, extent, overlap, tilt, air, density in SITES[: options.first]:
        yield simulate_pair(
            kind,
            seed + options.reseed,
            extent_m=extent,
            overlap=overlap,
            tilt_deg=tilt,
            ground="robot",
            air=air,
            air_density=density,
        )


def low_overlap(count: int, first_seed: int) -> Iterator[SimulatedPair]:
    """Yield so many pairs that share 10 to 25 %, of seeds from the first on that show anything."""
    found = 0
    for seed in itertools.count(first_seed):
        if found >= count:
            return
        chance = np.random.default_rng([seed, 41])
        try:
            pair = simulate_pair(
                KINDS[seed % len(KINDS)],
                seed,
                extent_m=170.0,
                overlap=float(chance.uniform(0.10, 0.25)),
                tilt_deg=0.0,
                ground=("robot", "tripod")[int(chance.integers(2))],
                air=("airborne", "uav")[int(chance.integers(2))],
                air_density=float(chance.uniform(4.0, 14.0)),
            )
        except NothingSeenError as error:
            print(f"left out: {error}", flush=True)
            continue
        found += 1
        yield pair


if __name__ == "__main__":
    main()

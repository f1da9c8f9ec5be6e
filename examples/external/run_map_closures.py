"""Match two maps with MapClosures 2.2 and write its transform; to be run in MapClosures' environment.

    python run_map_closures.py SOURCE TARGET RESULT [--resolution 1.0]

SOURCE and TARGET are NPY. MapClosures looks for places seen before in a sequence of local maps: ORB features
of bird's-eye-view point densities, aligned in two dimensions, with a plane of ground for the rest. The source
is its first map here, and the target a later one that closes a loop. It ends with 1 where it finds none, by
its own threshold.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from map_closures.config import MapClosuresConfig
from map_closures.map_closures import MapClosures

FIRST, LATER = 0, 10
"""Numbers of the two maps; MapClosures leaves the last three before a map out of its search."""


def main() -> None:
    """Add the source, ask for the closure of the target."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("source", "target", "result"):
        parser.add_argument(name, type=Path)
    # its own default of 0.5 m is for maps of whole scans: of thinned clouds it fills hardly a cell
    parser.add_argument("--resolution", type=float, default=1.0, help="cell of the density map, metres")
    options = parser.parse_args()
    config = MapClosuresConfig(density_map_resolution=options.resolution)
    closures = MapClosures(config)
    closures.get_best_closure(FIRST, np.load(options.source))
    closure = closures.get_best_closure(LATER, np.load(options.target))
    count = int(closure.number_of_inliers)
    print(f"{count} matches agree, {config.inliers_threshold} wanted")
    if count < config.inliers_threshold:
        sys.exit("no closure found: too few matches agree")
    # from the map seen first to the one that closes the loop
    np.savetxt(options.result, np.asarray(closure.pose, float), "%.17g")


if __name__ == "__main__":
    main()

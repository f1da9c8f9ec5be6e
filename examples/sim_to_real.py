"""Compare simulated pairs with real ones: heights, density, edges, and the margins of benchmark runs.

    python examples/sim_to_real.py SIMULATED REAL [--runs results_simulated results_real]

SIMULATED and REAL are folders of pairs; ``--runs`` are results' folders of `mtpcr-geo benchmark`. Sources
are compared with sources and targets with targets. A figure whose simulated median lies outside the real
clouds' range is marked: there the simulator is a toy.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mtpcr_geo.benchmark.pairs import load_pair, pair_folders
from mtpcr_geo.benchmark.protocol import RUNS, read_rows
from mtpcr_geo.benchmark.sim_to_real import cloud_figures, compare, margins
from mtpcr_geo.benchmark.tables import to_markdown


def main() -> None:
    """Print the comparison as Markdown."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("simulated", type=Path, help="folder of simulated pairs")
    parser.add_argument("real", type=Path, help="folder of real pairs")
    parser.add_argument("--cell", type=float, default=1.0, help="cell of the height rasters, metres")
    parser.add_argument("--runs", type=Path, nargs=2, help="results on the simulated and on the real pairs")
    options = parser.parse_args()
    pairs = [
        [load_pair(folder) for folder in pair_folders(data)] for data in (options.simulated, options.real)
    ]
    for role in ("source", "target"):
        figures = [[cloud_figures(getattr(pair, role), options.cell) for pair in group] for group in pairs]
        print(f"## {role.capitalize()}s\n\n{to_markdown(compare(*figures))}")
    for name, folder in zip(("simulated", "real"), options.runs or (), strict=False):
        lines = margins(read_rows(folder / RUNS))
        print(f"## Margins of the best pose over the next, {name}\n\n{to_markdown(lines)}")


if __name__ == "__main__":
    main()

"""Times a height raster from a cloud: our reader and raster against PDAL's readers.las and writers.gdal.

    python examples/benchmark_bev.py cloud.laz --cell 1 --runs 3

Every run is a process of its own, start-up included; the two programs take turns. mtpcr-geo makes highest z,
lowest z and point count, PDAL only the highest z.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

MTPCR_GEO = """
import sys, mtpcr_geo
cloud, cell, out = sys.argv[1:]
mtpcr_geo.Pipeline([
    cloud,
    {"type": "mtpcr.level", "method": "none"},
    {"type": "mtpcr.bev", "cell": float(cell)},
    {"type": "mtpcr.write_bev", "filename": out},
], overwrite=True).execute()
"""
PDAL = """
import json, sys, pdal
cloud, cell, out = sys.argv[1:]
raster = {"type": "writers.gdal", "filename": out, "resolution": float(cell), "output_type": "max",
          "gdaldriver": "GTiff", "data_type": "float32"}
pipeline = pdal.Pipeline(json.dumps([cloud, raster]))
pipeline.execute_streaming(chunk_size=1000000)
"""
PEAK = "\nimport resource\nprint(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"


def measure(code: str, cloud: Path, cell: float, out: Path) -> tuple[float, float]:
    """Run code in a process of its own: (seconds, peak memory in MiB)."""
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code + PEAK, str(cloud), str(cell), str(out)],
        capture_output=True,
        text=True,
        check=True,
    )
    return time.perf_counter() - start, int(done.stdout.split()[-1]) / 1024


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("cloud", type=Path)
    parser.add_argument("--cell", type=float, default=1.0, help="metres")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    found: dict[str, list[tuple[float, float]]] = {"mtpcr-geo": [], "PDAL": []}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(chosen.runs):
            for name, code in (("mtpcr-geo", MTPCR_GEO), ("PDAL", PDAL)):
                found[name].append(measure(code, chosen.cloud, chosen.cell, Path(folder) / f"{name}.tif"))
    table = {
        name: {"best_s": min(t for t, _ in runs), "peak_mib": max(m for _, m in runs)}
        for name, runs in found.items()
    }
    if chosen.json:
        print(json.dumps(table))
        return
    print(f"{chosen.cloud}, cell {chosen.cell:g} m, best of {chosen.runs}")
    for name, row in table.items():
        print(f"{name:12} {row['best_s']:6.2f} s  {row['peak_mib']:7.0f} MiB")


if __name__ == "__main__":
    main()

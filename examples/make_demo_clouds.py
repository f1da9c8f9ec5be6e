"""Make again the clouds that ``mtpcr-geo demo`` registers (needs the extra ``benchmark``).

    python examples/make_demo_clouds.py FOLDER [--overwrite]

Those in the package were written by ``python examples/make_demo_clouds.py mtpcr_geo/cli/demo_clouds``. For
other sites see ``mtpcr-geo simulate``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from mtpcr_geo.benchmark.demo_clouds import write_demo


def main() -> None:
    """Simulate and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="where to write the three files")
    parser.add_argument("--overwrite", action="store_true", help="replace files that are there")
    options = parser.parse_args()
    for path in write_demo(options.folder, overwrite=options.overwrite):
        print(f"{path.stat().st_size / 1e6:6.2f} MB  {path}")


if __name__ == "__main__":
    main()

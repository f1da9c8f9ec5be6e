"""Register a forest plot with Sylva (sylva-rs 0.3) and write its transform; to be run in Sylva's environment.

    python run_sylva.py SOURCE TARGET RESULT [--ground pmf] [--radius METRES]

SOURCE and TARGET are NPY. What the command ``sylva fusion-register`` does, by the function that it calls.
Sylva wants classified ground in both clouds, which one of its own filters finds here: the morphological one
(``classify_ground_pmf``), since its cloth (``--ground csf``, its default for dense plots) hangs in the crowns
of clouds that show little ground. It also wants a rough place to search around: the middle of the source on
that of the target, with a radius that reaches the whole target, and all headings. It gives no verdict; its
report is printed, and kept with the run.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from sylva import PointCloud, fusion, ground


def main() -> None:
    """Classify, search, refine; Sylva raises where it finds no pose."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("source", "target", "result"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--ground", choices=("pmf", "csf"), default="pmf", help="which of its ground filters")
    parser.add_argument("--radius", type=float, help="search radius, metres; the whole target if not given")
    options = parser.parse_args()
    source, target = np.load(options.source), np.load(options.target)
    initial = np.eye(4)
    initial[:3, 3] = middle(target) - middle(source)
    radius = options.radius
    if radius is None:
        radius = float(np.linalg.norm(np.ptp(target[:, :2], axis=0))) / 2
    classify = getattr(ground, f"classify_ground_{options.ground}")
    plot, block = (classify(PointCloud(xyz)) for xyz in (source, target))
    found = fusion.register(plot, block, initial, search_radius=radius)
    print(found.report())
    np.savetxt(options.result, np.asarray(found.transform, float), "%.17g")


def middle(xyz: np.ndarray) -> np.ndarray:
    """Return the middle of a cloud's bounds in plan, at the height of its lower points."""
    plan = (xyz[:, :2].min(axis=0) + xyz[:, :2].max(axis=0)) / 2
    return np.append(plan, np.percentile(xyz[:, 2], 10))


if __name__ == "__main__":
    main()

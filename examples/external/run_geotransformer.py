"""Run GeoTransformer's demonstration on two point files and write its transform, without its windows.

    python run_geotransformer.py CHECKOUT WEIGHTS SOURCE TARGET RESULT [--scale 12]

Its 3DMatch weights know rooms: coordinates are divided by the scale, and the translation multiplied by it.
To be run in GeoTransformer's own environment, which needs a CUDA device.
"""

from __future__ import annotations

import argparse
import os
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np

EXPERIMENT = "experiments/geotransformer.3dmatch.stage4.gse.k3.max.oacl.stage2.sinkhorn"


def main() -> None:
    """Point the demonstration at our clouds, and keep the transform that it judges."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("checkout", "weights", "source", "target", "result"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--scale", type=float, default=12.0)
    options = parser.parse_args()
    folder, result, weights = (
        options.source.resolve().parent,
        options.result.resolve(),
        options.weights.resolve(),
    )
    files = {}
    for role in ("source", "target"):
        files[role] = folder / f"{role}_scaled.npy"
        np.save(files[role], np.load(getattr(options, role)) / options.scale)
    # it wants a truth to print errors against; any will do
    files["truth"] = folder / "truth.npy"
    np.save(files["truth"], np.eye(4))
    sys.path[:0] = [str(options.checkout.resolve()), str(options.checkout.resolve() / EXPERIMENT)]
    os.chdir(options.checkout / EXPERIMENT)
    import geotransformer.utils.open3d as drawing
    import geotransformer.utils.registration as judging

    def kept(truth: Any, estimated: Any) -> tuple[float, float]:
        T = np.array(estimated, float)
        T[:3, 3] *= options.scale
        np.savetxt(result, T, "%.17g")
        return 0.0, 0.0

    drawing.draw_geometries = lambda *shapes: None
    judging.compute_registration_error = kept
    sys.argv = ["demo.py", "--src_file", str(files["source"]), "--ref_file", str(files["target"])]
    sys.argv += ["--gt_file", str(files["truth"]), "--weights", str(weights)]
    runpy.run_path("demo.py", run_name="__main__")


if __name__ == "__main__":
    main()

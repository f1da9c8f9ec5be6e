"""Run Predator's demonstration on two point files and write its transform as text, without its windows.

    python run_predator.py CHECKOUT SOURCE TARGET RESULT [--scale 12] [--config configs/test/indoor.yaml]

Its indoor weights know rooms: coordinates are divided by the scale, and the translation multiplied by it.
To be run in Predator's own environment.
"""

from __future__ import annotations

import argparse
import os
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml


def main() -> None:
    """Point the demonstration at our clouds, and stop it once it knows the transform."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("checkout", "source", "target", "result"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--scale", type=float, default=12.0)
    parser.add_argument("--config", default="configs/test/indoor.yaml")
    options = parser.parse_args()
    folder, result = options.source.resolve().parent, options.result.resolve()
    config = yaml.safe_load((options.checkout / options.config).read_text())
    for role, key in (("source", "src_pcd"), ("target", "tgt_pcd")):
        path = folder / f"{role}.pth"
        torch.save(np.load(getattr(options, role)) / options.scale, path)
        replace(config, key, str(path))
    own_config = folder / "config.yaml"
    own_config.write_text(yaml.safe_dump(config))
    # its modules and weights are found from its checkout
    os.chdir(options.checkout)
    sys.path.insert(0, os.getcwd())
    import lib.benchmark_utils as kit

    estimate = kit.ransac_pose_estimation

    def kept(*arguments: Any, **more: Any) -> Any:
        T = np.array(estimate(*arguments, **more), float)
        T[:3, 3] *= options.scale
        np.savetxt(result, T, "%.17g")
        raise SystemExit(0)

    kit.ransac_pose_estimation = kept
    sys.argv = ["scripts/demo.py", str(own_config)]
    runpy.run_path("scripts/demo.py", run_name="__main__")


def replace(config: dict[str, Any], key: str, value: str) -> None:
    """Set a key wherever it stands in nested sections; at the top where it stands nowhere."""
    holders = [part for part in (config, *config.values()) if isinstance(part, dict) and key in part]
    for holder in holders or [config]:
        holder[key] = value


if __name__ == "__main__":
    main()

"""Run CODEM on two LAZ files and write its transform as text; to be run in CODEM's own environment.

    python run_codem.py SOURCE TARGET RESULT

The target is CODEM's foundation, the source its area of interest. Scale is held at one: the benchmark asks
for rigid transforms.
"""

from __future__ import annotations

import dataclasses
import sys

import codem
import numpy as np
from codem.lib.log import Log


def main() -> None:
    """Register coarse and fine, without applying the result to the file."""
    source, target, result = sys.argv[1:]
    chosen = codem.CodemRunConfig(
        target, source, DSM_SOLVE_SCALE=False, ICP_SOLVE_SCALE=False, LOG_TYPE="console"
    )
    config = dataclasses.asdict(chosen)
    config["log"] = Log(config)
    foundation, moving = codem.preprocess(config)
    foundation.prep()
    moving.prep()
    coarse = codem.coarse_registration(foundation, moving, config)
    fine = codem.fine_registration(foundation, moving, coarse, config)
    np.savetxt(result, np.asarray(fine.registration_parameters["matrix"], float), "%.17g")


if __name__ == "__main__":
    main()

"""Train both networks and write them: ``python -m mtpcr_geo.benchmark.train OUT``."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

from mtpcr_geo.benchmark.train.recipe import Recipe, train
from mtpcr_geo.core.errors import MtpcrError


def main() -> None:
    """Run what the command line asks for."""
    usual = Recipe()
    parser = argparse.ArgumentParser(prog="python -m mtpcr_geo.benchmark.train", description=__doc__)
    parser.add_argument(
        "out", type=Path, help="folder for bev_point.onnx, bev_glue.onnx, curve.csv, run.json"
    )
    parser.add_argument("--clouds", type=Path, help="folder where simulated clouds are kept; OUT/clouds")
    for name, about in Recipe.ABOUT.items():
        parser.add_argument(
            f"--{name.replace('_', '-')}",
            type=type(getattr(usual, name)),
            default=getattr(usual, name),
            help=about,
        )
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="stop after so many, to be taken up again"
    )
    given = vars(parser.parse_args())
    out, clouds, minutes = given.pop("out"), given.pop("clouds"), given.pop("minutes")
    began = time.monotonic()

    def say(line: str) -> None:
        print(f"{time.monotonic() - began:7.0f} s  {line}", file=sys.stderr, flush=True)

    try:
        facts = train(
            Recipe(**given), out, clouds=clouds or out / "clouds", until=began + 60 * minutes, say=say
        )
    except MtpcrError as error:
        sys.exit(str(error))
    print(json.dumps(facts, indent=1))


if __name__ == "__main__":
    main()

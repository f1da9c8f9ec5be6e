"""Repeat the paper's ablation: its resolution (RES), FOCUS and image enhancement (IE), each on or off.

    python examples/ablation.py DATA --only farmland campus --matcher rootsift --starts 5

DATA holds a folder for each pair, as for benchmark_matchers.py. Every start turns the source by up to 90
degrees and shifts it by up to 100 m, as in the paper; the clouds stand upright, so levelling takes no part.
Steps are those of ``register --profile paper``; with ``--robust`` the SVD starts from the yaw and shift that
most tie points agree on, since one SVD over many outliers does not recover, whatever the image. With
``--band-pass`` enhancement means our band-passed heights in place of the paper's two filters. The profile
gives ``--matcher bev`` the image and the cells that it was trained on: its RES chooses one cell for both
clouds by their density, against 1 m without, and its enhancement is the band pass. With ``--printed`` it gets
the paper's cells (Eq. 1) and filters (Eq. 3 and 4) too.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark import metrics
from mtpcr_geo.benchmark.pairs import BenchmarkPair, load_pair, pair_folders
from mtpcr_geo.benchmark.steps import follow, level_pair, random_start, steps_of
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import MtpcrError
from mtpcr_geo.crs.chain import TransformChain


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, nargs="+", help="folders of pairs")
    parser.add_argument("--only", nargs="*", default=[], help="pairs whose name contains one of these")
    parser.add_argument("--matcher", default="rootsift", help="matcher of all runs")
    parser.add_argument("--models", type=Path, help="folder of model files")
    parser.add_argument("--starts", type=int, default=5, help="random starts of each pair")
    parser.add_argument("--seed", type=int, default=0, help="seed of the starts")
    parser.add_argument(
        "--robust", action="store_true", help="start the SVD from what most tie points agree on"
    )
    images = parser.add_mutually_exclusive_group()
    images.add_argument("--band-pass", action="store_true", help="band-passed heights as enhancement")
    images.add_argument(
        "--printed",
        action="store_true",
        help="the paper's cells and filters, whatever the matcher was trained on",
    )
    options = parser.parse_args()
    try:
        for folder in (f for data in options.data for f in pair_folders(data, tuple(options.only))):
            print(ablated(load_pair(folder), options), flush=True)
    except MtpcrError as error:
        sys.exit(str(error))


def ablated(pair: BenchmarkPair, options: argparse.Namespace) -> str:
    """Run all eight combinations on one pair, and tabulate."""
    rows: dict[tuple[bool, ...], list[dict[str, Any]]] = {}
    rng = np.random.default_rng([options.seed, zlib.crc32(pair.name.encode())])
    centroid = pair.source.mean(axis=0)
    for _ in range(options.starts):
        T_moved = random_start(rng, centroid, yaw_deg=90.0)
        levelled = level_pair(transforms.apply(T_moved, pair.source), pair.target, "none")
        T_true = transforms.inverse(T_moved)
        for res, focus, enhance in itertools.product((True, False), repeat=3):
            steps = steps_of(
                profile="paper",
                matcher=options.matcher,
                models=options.models,
                res=res,
                focus=focus,
                enhance=enhance,
            )
            for step in steps:
                if step["type"] == "mtpcr.solve" and options.robust:
                    step |= {"robust_start": True, "upright": True, "tries": 20_000}
                if step["type"] == "mtpcr.enhance" and enhance and options.band_pass:
                    step["look"] = "band_pass"
                if step["type"] == "mtpcr.enhance" and enhance and options.printed:
                    step["look"] = "paper"
                if step["type"] == "mtpcr.bev" and res and options.printed:
                    step["resolution"] = "eq1"
            done = follow(levelled, steps)
            T = TransformChain.of(done.pair).T_file if done.pair.T_target_source is not None else None
            found = done.pair.matches.report if done.pair.matches is not None else {}
            row: dict[str, Any] = {
                "right": False,
                "matches": len(done.pair.matches.score) if done.pair.matches is not None else 0,
                "agreeing": agreeing(found),
                "time_s": sum(done.seconds.values()),
            }
            if T is not None:
                errors = metrics.pose_errors(T, T_true, done.pair.source.sample[::50], np.zeros(3))
                row |= {"e_r": errors.rotation_deg, "e_t": errors.translation_m, "rmsd": errors.rmsd_m}
                row["right"] = errors.within()
            rows.setdefault((res, focus, enhance), []).append(row)
    said = {"robust start": options.robust, "band-passed": options.band_pass, "as printed": options.printed}
    lines = [
        ", ".join(
            [pair.name, options.matcher, f"{options.starts} starts", *(k for k, on in said.items() if on)]
        ),
        f"{'RES':>5}{'FOCUS':>7}{'IE':>5}{'success':>9}{'e_r deg':>10}{'e_t m':>10}{'RMSD m':>10}"
        f"{'matches':>9}{'agreeing':>10}{'s':>7}",
    ]
    for switches, some in rows.items():
        on = "".join(
            f"{'yes' if used else '-':>{width}}" for used, width in zip(switches, (5, 7, 5), strict=True)
        )
        cells = "".join(
            mean(some, key, form) for key, form in (("e_r", "10.2f"), ("e_t", "10.2f"), ("rmsd", "10.2f"))
        )
        more = "".join(
            mean(some, key, form)
            for key, form in (("matches", "9.0f"), ("agreeing", "10.1f"), ("time_s", "7.1f"))
        )
        lines.append(f"{on}{sum(r['right'] for r in some):>6}/{len(some):<2}{cells}{more}")
    return "\n".join([*lines, "means over the runs that found a transform; agreeing: on one yaw and shift\n"])


def agreeing(report: dict[str, Any]) -> int:
    """Count the matches that agree on one yaw and shift, after FOCUS where it was of use."""
    focus = report.get("focus")
    if focus is None:
        return int(report.get("agreeing", 0))
    return int(focus["agreeing_after"] if focus["applied"] else focus["agreeing_before"])


def mean(rows: list[dict[str, Any]], key: str, form: str) -> str:
    """Print a mean over the rows that have the value."""
    values = [row[key] for row in rows if key in row]
    return format(np.mean(values), form) if values else format("-", ">" + form.split(".")[0])


if __name__ == "__main__":
    main()

"""Compare matchers on pairs with known transforms, from random starts: success, errors, time, memory.

    python examples/benchmark_matchers.py DATA [DATA ...] --starts 10 --models MODELS

DATA holds a folder for each pair: source.laz, target.laz and pair.json with the true transform. Every start
turns the source by any yaw and shifts it by up to 100 m; ``--tilt 4`` tilts it too, and has it levelled.
All matchers see the same starts, at the cells that `register` gives them; `correlation` needs no image. A
run is right when it ends within 5 degrees and 2 m of the truth (the source's centroid), whatever its verdict.
Time is from matching to verdict; memory is the process's peak meanwhile, clouds and libraries included.
"""

from __future__ import annotations

import argparse
import csv
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo import geometry
from mtpcr_geo.errors import MtpcrError
from mtpcr_geo.evaluate import metrics
from mtpcr_geo.evaluate.pairs import load_pair, pair_folders
from mtpcr_geo.evaluate.steps import follow, level_pair, random_start, steps_of

FIELDS = (
    "pair", "start", "matcher", "image", "verdict", "right", "rotation_deg", "distance_m", "matches",
    "agreeing", "time_s", "match_s", "memory_mib", "why",
)  # fmt: skip


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, nargs="+", help="folders of pairs")
    parser.add_argument("--starts", type=int, default=10, help="random starts of each pair")
    parser.add_argument("--seed", type=int, default=0, help="seed of the starts")
    parser.add_argument("--tilt", type=float, default=0.0, help="largest tilt of a start, degrees")
    parser.add_argument("--matchers", nargs="+", default=["correlation", "rootsift", "xfeat", "aliked"])
    parser.add_argument("--images", nargs="+", default=["band_pass", "paper"], help="looks of mtpcr.enhance")
    parser.add_argument("--models", type=Path, help="folder of model files")
    parser.add_argument("--only", nargs="*", default=[], help="pairs whose name contains one of these")
    parser.add_argument("--unrelated", action="store_true", help="each source against the other targets")
    parser.add_argument("--csv", type=Path, help="write one row a run")
    options = parser.parse_args()
    rows = []
    try:
        for row in runs(options):
            rows.append(row)
            print(line_of(row), file=sys.stderr, flush=True)
    except MtpcrError as error:
        sys.exit(str(error))
    if options.csv:
        with options.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            writer.writeheader()
            writer.writerows(rows)
    print(table(rows))


def runs(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Run every matcher from every start of every pair."""
    folders = [f for data in options.data for f in pair_folders(data, tuple(options.only))]
    pairs = [load_pair(folder) for folder in folders]
    for k, pair in enumerate(pairs):
        others = [other for other in pairs if other is not pair] if options.unrelated else [pair]
        rng = np.random.default_rng([options.seed, zlib.crc32(pair.name.encode())])
        for start in range(options.starts):
            other = others[(start + k) % len(others)]
            name = pair.name if other is pair else f"{pair.name[:15]} / {other.name[:15]}"
            centroid = pair.source.mean(axis=0)
            T_moved = random_start(rng, centroid, tilt_deg=options.tilt)
            moved = geometry.apply(T_moved, pair.source)
            levelled = level_pair(moved, other.target, "auto" if options.tilt else "none")
            rasters: dict[str, Any] = {}
            for matcher, look in variants(options):
                raster, *steps = steps_of(matcher=matcher, models=options.models)
                if str(raster) not in rasters:
                    rasters[str(raster)] = follow(levelled, [raster]).pair
                if look != "-":
                    steps = [{"type": "mtpcr.enhance", "tag": "enhance", "look": look}, *steps]
                done = follow(rasters[str(raster)], steps)
                T = done.pair.T_file if done.pair.T_target_source is not None else None
                row = {
                    "pair": name, "start": start, "matcher": matcher, "image": look, "verdict": done.verdict,
                    "matches": len(done.pair.matches.score) if done.pair.matches else 0,
                    "agreeing": int(done.pair.ties.inlier.sum()) if T is not None else 0,
                    "time_s": sum(done.seconds.values()), "match_s": done.seconds.get("mtpcr.match"),
                    "memory_mib": done.memory_mib, "right": False,
                    "why": done.failure or "; ".join(done.pair.verdict.reasons),
                }  # fmt: skip
                if T is not None and other is pair:
                    T_true = geometry.inverse(T_moved)
                    plan, height = metrics.centroid_errors(
                        T, T_true, geometry.apply(T_moved, centroid[None])[0]
                    )
                    row["rotation_deg"] = metrics.rotation_error_deg(T, T_true)
                    row["distance_m"] = float(np.hypot(plan, height))
                    row["right"] = row["rotation_deg"] < 5.0 and row["distance_m"] < 2.0
                yield row


def variants(options: argparse.Namespace) -> list[tuple[str, str]]:
    """List the matchers with the images they see."""
    return [
        (matcher, look)
        for matcher in options.matchers
        for look in (["-"] if matcher == "correlation" else options.images)
    ]


def line_of(row: dict[str, Any]) -> str:
    """Print one run in one line."""
    rotation, distance = row.get("rotation_deg"), row.get("distance_m")
    errors = f"{rotation:8.3f} {distance:9.3f}" if rotation is not None else f"{'-':>8} {'-':>9}"
    kind = f"{row['matcher'][:12]:12} {row['image'][:10]:10} {row['verdict']:9}"
    agreeing = f"{row['agreeing']:4}/{row['matches']:<5} {row['time_s']:6.1f} s"
    return (
        f"{row['pair'][:33]:33} {row['start']:2} {kind}{'right' if row['right'] else '':6}{errors} {agreeing}"
    )


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate: right and accepted runs of each pair, errors of the right ones, time and memory."""
    kinds = list(dict.fromkeys((row["matcher"], row["image"]) for row in rows))
    pairs = list(dict.fromkeys(row["pair"] for row in rows))
    lines = [f"right (accepted) of runs; {rows[-1]['start'] + 1} starts" if rows else "no runs"]
    lines.append(f"{'pair':34}" + "".join(f"{m[:11]:>12}" for m, _ in kinds))
    lines.append(f"{'':34}" + "".join(f"{look[:11]:>12}" for _, look in kinds))

    def cells(label: str, of: Any) -> str:
        return f"{label[:33]:34}" + "".join(
            f"{of([r for r in rows if (r['matcher'], r['image']) == kind]):>12}" for kind in kinds
        )

    def counted(some: list[dict[str, Any]]) -> str:
        right, accepted = (sum(r["right"] for r in some), sum(r["verdict"] == "accepted" for r in some))
        return f"{right}/{len(some)} ({accepted})"

    def median(key: str, form: str, only_right: bool = True, most: bool = False) -> Any:
        def of(some: list[dict[str, Any]]) -> str:
            values = [r[key] for r in some if r.get(key) is not None and (r["right"] or not only_right)]
            return format(np.max(values) if most else np.median(values), form) if values else "-"

        return of

    for name in pairs:
        lines.append(cells(name, lambda some, name=name: counted([r for r in some if r["pair"] == name])))
    lines.append(cells("all", counted))
    lines.append(
        cells(
            "accepted but wrong",
            lambda some: str(sum(r["verdict"] == "accepted" and not r["right"] for r in some)),
        )
    )
    lines.append(cells("rotation, median of right, deg", median("rotation_deg", ".3f")))
    lines.append(cells("distance, median of right, m", median("distance_m", ".3f")))
    lines.append(cells("matching to verdict, median, s", median("time_s", ".1f", False)))
    lines.append(cells("of this matching, median, s", median("match_s", ".1f", False)))
    lines.append(cells("peak memory, MiB", median("memory_mib", ".0f", False, True)))
    return "\n".join(lines)


if __name__ == "__main__":
    main()

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

from mtpcr_geo.benchmark import metrics
from mtpcr_geo.benchmark.pairs import load_pair, pair_folders
from mtpcr_geo.benchmark.steps import follow, level_pair, random_start, steps_of
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import MtpcrError
from mtpcr_geo.crs.chain import TransformChain

FIELDS = (
    "pair", "seed", "tilt_deg", "start", "matcher", "image", "verdict", "right", "rotation_deg", "distance_m",
    "matches", "agreeing", "time_s", "match_s", "memory_mib", "why",
)  # fmt: skip
KEY = ("pair", "seed", "tilt_deg", "start", "matcher", "image")


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, nargs="+", help="folders of pairs")
    parser.add_argument("--starts", type=int, default=10, help="random starts of each pair")
    parser.add_argument("--seed", type=int, default=0, help="seed of the starts")
    parser.add_argument("--tilt", type=float, default=0.0, help="largest tilt of a start, degrees")
    parser.add_argument(
        "--matchers",
        nargs="+",
        default=["correlation", "rootsift", "xfeat", "aliked"],
        help="matchers, or a matcher with one image, such as aliked:band_pass",
    )
    parser.add_argument("--images", nargs="+", default=["band_pass", "paper"], help="looks of mtpcr.enhance")
    parser.add_argument("--models", type=Path, help="folder of model files")
    parser.add_argument("--only", nargs="*", default=[], help="pairs whose name contains one of these")
    parser.add_argument("--unrelated", action="store_true", help="each source against the other targets")
    parser.add_argument("--csv", type=Path, help="one row a run; runs that it holds already are not repeated")
    options = parser.parse_args()
    done = read_rows(options.csv) if options.csv and options.csv.exists() else {}
    rows = []
    try:
        for row in runs(options, done):
            rows.append(row)
            if key_of(row) not in done:
                print(line_of(row), file=sys.stderr, flush=True)
                append(options.csv, row)
    except MtpcrError as error:
        sys.exit(str(error))
    print(table(rows))


def key_of(row: dict[str, Any]) -> tuple[str, ...]:
    """Return what distinguishes one run from another."""
    return tuple(str(row[name]) for name in KEY)


def read_rows(path: Path) -> dict[tuple[str, ...], dict[str, Any]]:
    """Read the rows of an earlier call, numbers as numbers."""

    def value(name: str, text: str) -> Any:
        if name in ("pair", "matcher", "image", "verdict", "why"):
            return text
        if name == "right":
            return text == "True"
        return int(text) if name in ("seed", "start", "matches", "agreeing") else float(text)

    with path.open(newline="") as file:
        rows = [{k: value(k, text) for k, text in row.items() if text != ""} for row in csv.DictReader(file)]
    return {key_of(row): row for row in rows}


def append(path: Path | None, row: dict[str, Any]) -> None:
    """Add a row to the file of results, at once: long benchmarks get interrupted."""
    if path is None:
        return
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if new:
            writer.writeheader()
        writer.writerow(row)


def runs(
    options: argparse.Namespace, done: dict[tuple[str, ...], dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Run every matcher from every start of every pair, but for what is done already."""
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
            run = (name, str(options.seed), str(options.tilt), str(start))
            keys = [(*run, *variant) for variant in variants(options)]
            yield from (done[key] for key in keys if key in done)
            left = [variant for key, variant in zip(keys, variants(options), strict=True) if key not in done]
            if not left:
                continue
            moved = transforms.apply(T_moved, pair.source)
            levelled = level_pair(moved, other.target, "auto" if options.tilt else "none")
            rasters: dict[str, Any] = {}
            for matcher, look in left:
                raster, *steps = steps_of(matcher=matcher, models=options.models)
                if str(raster) not in rasters:
                    rasters[str(raster)] = follow(levelled, [raster]).pair
                if look != "-":
                    steps = [{"type": "mtpcr.enhance", "tag": "enhance", "look": look}, *steps]
                outcome = follow(rasters[str(raster)], steps)
                T = (
                    TransformChain.of(outcome.pair).T_file
                    if outcome.pair.T_target_source is not None
                    else None
                )
                row = {
                    "pair": name, "seed": options.seed, "tilt_deg": options.tilt, "start": start,
                    "matcher": matcher, "image": look,
                    "verdict": outcome.verdict,
                    "matches": len(outcome.pair.matches.score) if outcome.pair.matches else 0,
                    "agreeing": int(outcome.pair.tie_points.inlier.sum()) if T is not None else 0,
                    "time_s": sum(outcome.seconds.values()), "match_s": outcome.seconds.get("mtpcr.match"),
                    "memory_mib": outcome.memory_mib, "right": False,
                    "why": outcome.failure or "; ".join(outcome.pair.verdict.reasons),
                }  # fmt: skip
                if T is not None and other is pair:
                    T_true = transforms.inverse(T_moved)
                    plan, height = metrics.centroid_errors(
                        T, T_true, transforms.apply(T_moved, centroid[None])[0]
                    )
                    row["rotation_deg"] = metrics.rotation_error_deg(T, T_true)
                    row["distance_m"] = float(np.hypot(plan, height))
                    row["right"] = row["rotation_deg"] < 5.0 and row["distance_m"] < 2.0
                yield row


def variants(options: argparse.Namespace) -> list[tuple[str, str]]:
    """List the matchers with the images they see."""
    found = []
    for matcher in options.matchers:
        name, _, look = matcher.partition(":")
        looks = ["-"] if name == "correlation" else [look] if look else options.images
        found += [(name, one) for one in looks]
    return found


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

"""Register every pair of a folder from random starts, each run a fresh command, and tabulate the errors.

    python examples/benchmark_pairs.py DATA --starts 10            every source turned by any yaw and moved
    python examples/benchmark_pairs.py DATA --unrelated            every source against the other targets
    python examples/benchmark_pairs.py DATA --as-is                every source as it stands

DATA holds a folder for each pair: source.laz, target.laz and pair.json with the true transform under
ground_truth.T_target_from_source. Time and peak memory are those of the whole process, start-up included.
Rotation error is the angle of ``T (T_true)^-1``; plan and height errors are those of the source's centroid.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from mtpcr_geo.benchmark import metrics
from mtpcr_geo.core import transforms

FIELDS = (
    "pair", "start", "verdict", "success", "rotation_deg", "plan_m", "height_m", "time_s", "memory_mb",
    "margin", "held_out_agreeing", "held_out", "sigma_plan_m", "registered", "reasons",
)  # fmt: skip


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of pairs")
    parser.add_argument("--starts", type=int, default=10, help="random starts of each pair")
    parser.add_argument("--seed", type=int, default=0, help="seed of the starts")
    parser.add_argument(
        "--unrelated", action="store_true", help="each source against the other pairs' targets"
    )
    parser.add_argument("--as-is", action="store_true", help="do not move the sources")
    parser.add_argument("--only", nargs="*", default=[], help="pairs whose name contains one of these")
    parser.add_argument("--csv", type=Path, help="write one row a run")
    options = parser.parse_args()
    folders = sorted(path.parent for path in options.data.glob("*/pair.json"))
    folders = [f for f in folders if not options.only or any(word in f.name for word in options.only)]
    if not folders:
        sys.exit(f"no pair.json in the folders of {options.data}")
    rows = []
    print(
        f"{'run':44} {'verdict':9} {'rot deg':>8} {'plan m':>8} {'z m':>8} {'s':>6} {'MiB':>6} {'margin':>7}"
    )
    for row in unrelated(folders) if options.unrelated else related(folders, options):
        rows.append(row)
        print(line_of(row), flush=True)
    if options.csv:
        with options.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            writer.writeheader()
            writer.writerows(rows)
    print(summary(rows, options.unrelated))


def related(folders: list[Path], options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Register each pair from its starts."""
    with tempfile.TemporaryDirectory() as scratch:
        for folder in folders:
            pair = json.loads((folder / "pair.json").read_text())
            rng = np.random.default_rng([options.seed, *folder.name.encode()])
            source = laspy.read(folder / "source.laz")
            xyz = np.column_stack([source.x, source.y, source.z])
            centroid = xyz.mean(axis=0)
            T_truth = np.array(pair["ground_truth"]["T_target_from_source"], float)
            offset = pair["ground_truth"].get("measured_vertical_offset", {})
            T_truth[2, 3] += offset.get("dz_target_minus_source_m", 0.0)
            for start in range(1 if options.as_is else options.starts):
                moved = folder / "source.laz"
                T_moved = np.eye(4)
                if not options.as_is:
                    T_moved = random_start(rng, centroid)
                    moved = Path(scratch) / "source.laz"
                    write_moved(source, transforms.apply(T_moved, xyz), moved)
                row = run(moved, folder / "target.laz", crs_options(folder, pair), Path(scratch) / "out")
                found = row.pop("T_target_source")
                if found is not None:
                    row |= errors(
                        found,
                        T_truth @ transforms.inverse(T_moved),
                        transforms.apply(T_moved, centroid[None])[0],
                    )
                yield {"pair": folder.name, "start": start, **row}


def unrelated(folders: list[Path]) -> Iterator[dict[str, Any]]:
    """Register each source with the targets it has nothing to do with."""
    with tempfile.TemporaryDirectory() as scratch:
        for a in folders:
            for b in folders:
                if a != b:
                    out = Path(scratch) / "out"
                    row = run(a / "source.laz", b / "target.laz", ["--local", "--level", "none"], out)
                    row.pop("T_target_source")
                    row["registered"] = (out / "registered.laz").exists()
                    yield {"pair": f"{a.name[:20]} / {b.name[:20]}", "start": 0, **row}


def random_start(rng: np.random.Generator, centroid: np.ndarray) -> np.ndarray:
    """Turn by any yaw about the centroid, and move by up to 100 m in any direction."""
    direction = rng.normal(size=3)
    shift = direction / np.linalg.norm(direction) * rng.uniform(0.0, 100.0)
    return transforms.translation(shift) @ transforms.about(
        centroid, transforms.yaw_matrix(rng.uniform(0, 2 * np.pi))
    )


def write_moved(source: laspy.LasData, xyz: np.ndarray, path: Path) -> None:
    """Write the source with other coordinates, everything else as it was."""
    moved = laspy.LasData(source.header, source.points.copy())
    moved.change_scaling(scales=np.minimum(source.header.scales, 0.001), offsets=np.floor(xyz.min(axis=0)))
    moved.x, moved.y, moved.z = xyz.T
    moved.write(path)


def crs_options(folder: Path, pair: dict[str, Any]) -> list[str]:
    """Return the CRS options for files without one, from pair.json."""
    options = []
    for role in ("source", "target"):
        with laspy.open(folder / f"{role}.laz") as file:
            if file.header.parse_crs() is None:
                code = re.search(r"EPSG:\d+(?:\+\d+)?", pair["crs"])
                local = f"{role} local" in pair["crs"] or code is None
                options += [f"--{role}-crs", "local" if local else code[0]]
    return options


def run(source: Path, target: Path, options: list[str], out: Path) -> dict[str, Any]:
    """Run the command once, and read what it left."""
    for old in out.glob("*.*"):
        old.unlink()
    command = [
        sys.executable,
        "-m",
        "mtpcr_geo.cli.app",
        "register",
        str(source),
        str(target),
        "-o",
        str(out),
    ]
    command += ["--overwrite", "--quiet", *options]
    began = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    reported = process.stderr.read()
    _, _, usage = os.wait4(process.pid, 0)
    row: dict[str, Any] = {"time_s": time.perf_counter() - began, "memory_mb": usage.ru_maxrss / 1024}
    row |= {"verdict": "error", "reasons": reported.strip(), "T_target_source": None}
    if (out / "run.json").exists():
        result = json.loads((out / "run.json").read_text())
        judged = result["metrics"]
        row |= {
            "verdict": result["verdict"],
            "reasons": "; ".join(result["reasons"]),
            "margin": judged.get("hypothesis_margin"),
            "held_out": judged.get("held_out_tie_points"),
            "held_out_agreeing": judged.get("held_out_agreeing"),
            "sigma_plan_m": judged.get("sigma_plan_far_m"),
        }
    if (out / "transform.json").exists():
        row["T_target_source"] = np.array(json.loads((out / "transform.json").read_text())["T_target_source"])
    return row


def errors(T: np.ndarray, T_truth: np.ndarray, centroid: np.ndarray) -> dict[str, Any]:
    """Errors of a transform against the truth, in file coordinates."""
    rotation = metrics.rotation_error_deg(T, T_truth)
    plan, height = metrics.centroid_errors(T, T_truth, centroid)
    success = rotation < 5.0 and np.hypot(plan, height) < 2.0
    return {"rotation_deg": rotation, "plan_m": plan, "height_m": height, "success": bool(success)}


def line_of(row: dict[str, Any]) -> str:
    """Print one run in one line."""

    def number(key: str, form: str, width: int) -> str:
        value = row.get(key)
        return " " * (width - 1) + "-" if value is None else format(value, f"{width}{form}")

    name = f"{row['pair']} {row['start']}"
    return (
        f"{name:44} {row['verdict']:9} {number('rotation_deg', '.3f', 8)} {number('plan_m', '.3f', 8)} "
        f"{number('height_m', '.3f', 8)} {number('time_s', '.2f', 6)} {number('memory_mb', '.0f', 6)} "
        f"{number('margin', '.1f', 7)} {'' if row['verdict'] == 'accepted' else row['reasons']}"
    )


def summary(rows: list[dict[str, Any]], unrelated_runs: bool) -> str:
    """Sum up: by pair, and over all."""
    if not rows:
        return "nothing to run"
    accepted = sum(row["verdict"] == "accepted" for row in rows)
    seconds, memory = [row["time_s"] for row in rows], [row["memory_mb"] for row in rows]
    reported = [
        f"\n{len(rows)} runs: {accepted} accepted; median {np.median(seconds):.2f} s, longest "
        f"{max(seconds):.2f} s; peak memory {max(memory):.0f} MiB"
    ]
    if unrelated_runs:
        reported.append(f"registered.laz written in {sum(bool(row.get('registered')) for row in rows)} runs")
        return "\n".join(reported)
    right = [bool(row.get("success")) for row in rows]
    wrong = sum(row["verdict"] == "accepted" and not row.get("success") for row in rows)
    reported.append(f"right within 5 degrees and 2 m: {sum(right)}; accepted but wrong: {wrong}")
    head = f"\n{'pair (median / worst)':28} {'accepted':>9} {'right':>7} {'rotation deg':>15} {'plan m':>15}"
    lines = [head + f" {'height m':>15} {'s':>13} {'MiB':>6}"]
    for name in [*dict.fromkeys(row["pair"] for row in rows), None]:
        own = [row for row in rows if name in (None, row["pair"])]
        lines.append(
            f"{name or 'all':28} {sum(r['verdict'] == 'accepted' for r in own):4} / {len(own):<3}"
            f" {sum(bool(r.get('success')) for r in own):3} / {len(own):<3}"
            + "".join(f"{spread(own, key):>16}" for key in ("rotation_deg", "plan_m", "height_m"))
            + f" {spread(own, 'time_s', 2):>13} {max(r['memory_mb'] for r in own):6.0f}"
        )
    return "\n".join([*lines, *reported])


def spread(rows: list[dict[str, Any]], key: str, digits: int = 3) -> str:
    """Median and worst absolute value of a column."""
    values = [abs(row[key]) for row in rows if row.get(key) is not None]
    return f"{np.median(values):.{digits}f} / {max(values):.{digits}f}" if values else "-"


if __name__ == "__main__":
    main()

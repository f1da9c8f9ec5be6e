"""What a run came to, in a few lines for a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from mtpcr_geo.core import transforms

if TYPE_CHECKING:
    from rich.console import Console

    from mtpcr_geo.pipeline.records import StageRecord
    from mtpcr_geo.pipeline.runner import RunResult
    from mtpcr_geo.registration import Registration

_COLOUR = {"accepted": "bold green", "doubtful": "bold yellow", "refused": "bold red"}
# the numbers most worth a look; --verbose shows all
_SHOWN = (
    "vertical_offset_m",
    "overlap_m2",
    "overlap_source",
    "overlap_target",
    "held_out_agreeing_share",
    "held_out_median_m",
    "hypothesis_margin",
    "sigma_yaw_deg",
    "sigma_plan_source_centroid_m",
    "sigma_height_m",
)
_OPEN_WITH = {
    "registered": "the moved cloud",
    "report": "the report, in any browser",
    "recording": "the recording, with: rerun",
    "tie_points": "tie points and footprints, in QGIS",
    "run": "everything as numbers",
}


def print_registration(console: Console, result: Registration, *, verbose: bool = False) -> None:
    """Print verdict, reasons, the transform in words, the checks, and which files to open."""
    from rich.table import Table
    from rich.text import Text

    name = result.verdict.name
    console.print(Text(name.upper(), _COLOUR[name]))
    for reason in result.verdict.reasons:
        console.print(Text(f"  {reason}"), soft_wrap=True)
    facts = Table(box=None, show_header=False, pad_edge=True, padding=(0, 1))
    for label, value in (*_transform_rows(result), *_metric_rows(result.verdict.metrics, verbose)):
        facts.add_row(label, value)
    if facts.row_count:
        console.print(facts)
    if verbose:
        _print_stages(console, result.report)
    for what, path in result.outputs.items():
        if what in _OPEN_WITH:
            console.print(Text(f"  {path}"), Text(_OPEN_WITH[what], "dim"), soft_wrap=True)
    if name == "refused" and "registered" not in result.outputs:
        console.print(Text("  no registered cloud was written; --force writes it all the same", "dim"))


def print_run(console: Console, result: RunResult, *, verbose: bool = False) -> None:
    """Print what a pipeline came to: the registration if it holds one, else its files."""
    from mtpcr_geo.registration import registration_of

    if result.verdict is not None:
        print_registration(console, registration_of(result), verbose=verbose)
    elif verbose:
        _print_stages(console, result.done)
    for path in result.outputs:
        console.print(f"  wrote {path}", soft_wrap=True, markup=False)


def _transform_rows(result: Registration) -> list[tuple[str, str]]:
    pair = result.pair
    if pair is None or pair.T_target_source is None or result.T_target_source is None:
        return []
    from mtpcr_geo.export.descriptions import result_text, shift_text

    R = pair.T_target_source[:3, :3]
    yaw = transforms.yaw_of(R)
    tilt = math.degrees(transforms.rotation_angle(transforms.yaw_matrix(yaw).T @ R))
    rows = [("yaw", f"{math.degrees(yaw):+.3f} degrees, tilt {tilt:.3f}")]
    shift = shift_text(pair)
    if shift:
        rows.append(("shift of the middle", shift))
    return [*rows, ("result in", result_text(pair))]


def _metric_rows(metrics: Mapping[str, Any], verbose: bool) -> list[tuple[str, str]]:
    from mtpcr_geo.export.descriptions import metric_rows

    chosen = {key: metrics[key] for key in _SHOWN if metrics.get(key) is not None}
    return metric_rows(metrics if verbose or not chosen else chosen)


def _print_stages(console: Console, done: Sequence[StageRecord]) -> None:
    for record in done:
        note = record.skipped or record.failed or ""
        console.print(f"  {record.seconds:8.2f} s  {record.tag} ({record.type}) {note}", soft_wrap=True)

"""What a run came to, in a few lines for a terminal: the verdict first, each fact once."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mtpcr_geo.core import transforms
from mtpcr_geo.core.wording import in_a_line
from mtpcr_geo.verdict.findings import chance_text

if TYPE_CHECKING:
    from rich.console import Console

    from mtpcr_geo.core.types import Verdict
    from mtpcr_geo.pipeline.records import StageRecord
    from mtpcr_geo.pipeline.runner import RunResult
    from mtpcr_geo.registration import Registration

SUMMARY_NEEDS = ("rich.console", "rich.table")
"""Modules that printing imports."""
_COLOUR = {"accepted": "bold green", "doubtful": "bold yellow", "refused": "bold red"}
_RESULT_FILES = {"registered": "the registered cloud", "transform": "the transform"}
# metrics of the verdict shown without --verbose
_SHOWN = ("vertical_offset_m", "held_out_median_m", "sigma_yaw_deg", "sigma_tilt_deg")
# and these where the reasons do not say them: what was accepted names them as its grounds
_SHOWN_UNLESS_ACCEPTED = (
    "overlap_m2",
    "overlap_source",
    "overlap_target",
    "held_out_agreeing_share",
    "hypothesis_margin",
)
_OPEN_WITH = {
    "registered": "the moved cloud",
    "registered_also": "the moved cloud, for other programs",
    "transform": "the transform, for mtpcr-geo apply; beside it for CloudCompare and PDAL",
    "report": "the report, in any browser",
    "recording": "the recording, with: mtpcr-geo review",
    "project": "before, after and evidence on a map, in QGIS",
    "tie_points": "tie points and footprints, in QGIS",
    "run": "everything as numbers",
}
# outputs that are named by their folder, by how their names begin
_OPEN_FOLDERS = {("bev_", "style_", "points"): "height rasters, in QGIS"}


def print_registration(
    result: Registration,
    *,
    verbose: bool = False,
    files: bool = True,
    console: Console | None = None,
    force_with: str = "--force writes it all the same",
) -> None:
    """Print the verdict in a sentence, its reasons, the transform in words, and which files to open.

    Args:
        result: what a registration came to.
        verbose: all metrics of the verdict; and, on standard error, the seconds of each stage.
        files: name the files to open.
        console: where to print; standard output if not given.
        force_with: how to have what the verdict withholds written.

    """
    from rich.table import Table
    from rich.text import Text

    console = console or _stdout()
    name = result.verdict.name
    head, _, rest = result.verdict.headline.partition(":")
    console.print(Text.assemble((f"{head}:", _COLOUR[name]), rest), soft_wrap=True)
    for reason in _unsaid(result.verdict):
        console.print(Text(in_a_line(f"  {reason}")), soft_wrap=True)
    facts = Table(box=None, show_header=False, pad_edge=True, padding=(0, 1))
    for label, value in (*_transform_rows(result), *_metric_rows(result.verdict, verbose)):
        facts.add_row(Text(in_a_line(label)), Text(in_a_line(value)))
    if facts.row_count:
        console.print(facts)
    if verbose:
        _print_stages(result.report)
    for one in _to_open(result) if files else ():
        console.print(Text(in_a_line(f"  {one.name}")), Text(one.what, "dim"), soft_wrap=True)
    for line in (*_withheld_lines(result, force_with), *_left_out_lines(result)):
        console.print(Text(in_a_line(f"  {line}"), "dim"), soft_wrap=True)


def print_run(result: RunResult, *, verbose: bool = False, console: Console | None = None) -> None:
    """Print what a pipeline came to: the registration if it holds one, and every file it wrote, once."""
    from mtpcr_geo.registration import registration_of

    console = console or _stdout()
    named: set[Path] = set()
    if result.verdict is not None:
        registration = registration_of(result)
        force_with = "force of mtpcr.apply and mtpcr.write_transform writes it all the same"
        print_registration(registration, verbose=verbose, console=console, force_with=force_with)
        named = {path for one in _to_open(registration) for path in one.files}
    elif verbose:
        _print_stages(result.done)
    for path in result.outputs:
        if path not in named:
            console.print(in_a_line(f"  wrote {path}"), soft_wrap=True, markup=False)


def _withheld_lines(result: Registration, force_with: str) -> list[str]:
    """Say which files of the result were not written and why, or that they were forced."""
    if result.forced:
        verdict = result.verdict
        kept_back = {"registered": verdict.withholds_cloud, "transform": verdict.withholds_transform}
        forced = [key for key, why in kept_back.items() if why is not None and key in result.outputs]
        what = " and ".join(_RESULT_FILES[key] for key in forced)
        return [f"written though {verdict.withholds_cloud}, since that was forced: {what or 'the result'}"]
    missing = [key for key in _RESULT_FILES if key in result.not_written]
    if not missing:
        return []
    what = " and ".join(_RESULT_FILES[key] for key in missing)
    possible = result.T_target_source is not None
    hint = f"; {force_with}" if possible else ""
    return [f"not written: {what}, since {result.not_written[missing[0]]}{hint}"]


def _left_out_lines(result: Registration) -> list[str]:
    """Say which points and dimensions could not be stored."""
    from mtpcr_geo.io.write_any import LeftOut

    said = []
    for record in result.report:
        missing = LeftOut.read(record.metadata)
        if missing != LeftOut():
            said += missing.sentences(Path(str(record.metadata["filename"])).name)
    return said


def _stdout() -> Console:
    from rich.console import Console

    return Console(highlight=False)


@dataclass(frozen=True)
class _Named:
    """What is named of the files of a run: a file, or a folder of several.

    Attributes:
        name: as it is printed.
        what: what it is.
        files: the files that are named by it.

    """

    name: str
    what: str
    files: tuple[Path, ...]


def _to_open(result: Registration) -> list[_Named]:
    """Return the files worth opening, in the order of the table above, then the folders."""
    outputs = result.outputs
    found = [
        _Named(str(outputs[key]), what, (outputs[key],)) for key, what in _OPEN_WITH.items() if key in outputs
    ]
    for start, what in _OPEN_FOLDERS.items():
        files = tuple(path for key, path in outputs.items() if key.startswith(start))
        if files:
            found.append(_Named(os.path.join(files[0].parent, ""), what, files))
    return found


def _unsaid(verdict: Verdict) -> list[str]:
    """Return the reasons that the headline does not give already."""
    chance = verdict.metrics.get("probability")
    said = {f"the pose is right with {chance_text(chance)}"} if chance is not None else set()
    return [one for one in verdict.reasons if one not in verdict.headline and one not in said]


def _transform_rows(result: Registration) -> list[tuple[str, str]]:
    pair = result.pair
    if pair is None or pair.T_target_source is None or result.T_target_source is None:
        return []
    from mtpcr_geo.export.descriptions import result_text, shift_text

    R = pair.T_target_source[:3, :3]
    yaw = transforms.yaw_of(R)
    tilt = math.degrees(transforms.tilt_of(R))
    rows = [("yaw", f"{math.degrees(yaw):+.3f} degrees, tilt {tilt:.3f}")]
    shift = shift_text(pair)
    if shift:
        rows.append(("shift of the centroid", shift))
    return [*rows, ("result in", result_text(pair))]


def _metric_rows(verdict: Verdict, verbose: bool) -> list[tuple[str, str]]:
    from mtpcr_geo.export.descriptions import metric_rows

    metrics = verdict.metrics
    shown = (*_SHOWN, *(_SHOWN_UNLESS_ACCEPTED if verdict.name != "accepted" else ()))
    chosen = {key: metrics[key] for key in shown if metrics.get(key) is not None}
    return metric_rows(metrics if verbose or not chosen else chosen)


def _print_stages(done: Sequence[StageRecord]) -> None:
    """Print what each stage took, on standard error: seconds, processor seconds, largest memory so far."""
    from rich.console import Console

    talk = Console(stderr=True, highlight=False)
    for record in done:
        note = record.skipped or record.failed or ""
        cpu, memory = record.used.get("cpu_s"), record.used.get("peak_memory_mb")
        more = ("" if cpu is None else f"  {cpu:8.2f} s of processors") + (
            "" if memory is None else f"  {memory:7.0f} MiB"
        )
        text = f"  {record.seconds:8.2f} s{more}  {record.tag} ({record.type}) {note}".rstrip()
        talk.print(in_a_line(text), soft_wrap=True, markup=False)

"""What a report says in words and numbers, as rows for its templates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core.types import Pair, Verdict
from mtpcr_geo.crs import TransformChain
from mtpcr_geo.export import descriptions
from mtpcr_geo.export.transform import frames_of
from mtpcr_geo.verdict.sentence import centimetres

if TYPE_CHECKING:
    from pyproj import CRS

STATUS_CLASS = {"passed": "ok", "not passed": "bad", "warning": "warn", "not checked": "none"}
_MOST_HYPOTHESES = 8
_MOST_STAGES, _LEAST_SHARE = 8, 0.5


@dataclass(frozen=True)
class Number:
    """A figure that stands in ``run.json`` too.

    Attributes:
        text: as it is printed, with its unit.
        value: the figure itself.
        path: where it stands in ``run.json``, keys joined by dots.
        bound: whether what is printed is rounded up, so that the figure lies below it.

    """

    text: str
    value: float
    path: str
    bound: bool = False


Words = tuple["str | Number", ...]
"""A text with figures in it."""


@dataclass(frozen=True)
class Row:
    """A row of a table: what it is, and its value."""

    name: str
    value: Words


def row(name: str, *value: str | Number) -> Row:
    """Return a row."""
    return Row(name, value)


def printed(verdict: Verdict, name: str) -> str:
    """Return a metric of a verdict as every place prints it, with its unit."""
    return descriptions.metric_rows({name: verdict.metrics[name]})[0][1]


def metric(verdict: Verdict, name: str, text: str, *, bound: bool = False) -> Number:
    """Return a metric of a verdict as it is printed."""
    return Number(text, verdict.metrics[name], f"metrics.{name}", bound)


@dataclass(frozen=True)
class Accuracy:
    """What 95 % of the errors stay below, and standard deviations.

    Attributes:
        columns: names of the places.
        rows: by name, a figure for each place; None where it has none.
        known_by: how it is known.

    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Number | None, ...]], ...]
    known_by: str


def accuracy(verdict: Verdict | None) -> Accuracy | None:
    """Return the expected errors; None where none are claimed or known."""
    if verdict is None or verdict.uncertainty is None or verdict.name == "refused":
        return None
    known = verdict.metrics

    def figures(kind: str, names: tuple[str, ...]) -> tuple[Number | None, ...]:
        found: list[Number | None] = []
        for name in names:
            key = f"{kind}_{name}"
            if key not in known:
                found.append(None)
                continue
            bound = kind == "within_95"
            text = f"{centimetres(known[key])} m" if bound else printed(verdict, key)
            found.append(metric(verdict, key, text, bound=bound))
        return tuple(found)

    blocks = verdict.uncertainty.blocks
    return Accuracy(
        ("middle of the overlap", "farthest point of the source"),
        (
            ("95 % of errors in plan are below", figures("within_95", ("plan_m", "plan_far_m"))),
            ("95 % of errors in height are below", figures("within_95", ("height_m", "height_far_m"))),
            ("standard deviation in plan", figures("sigma", ("plan_m", "plan_far_m"))),
            ("standard deviation in height", figures("sigma", ("height_m", "height_far_m"))),
        ),
        f"from a block jackknife of the final fit to {verdict.uncertainty.fitted}, {blocks} blocks",
    )


def rotation_rows(verdict: Verdict | None) -> list[Row]:
    """Return the standard deviations of the rotation, and how probable it is that the pose is precise."""
    if verdict is None or verdict.uncertainty is None or verdict.name == "refused":
        return []
    named = [(f"standard deviation of the {one}", f"sigma_{one}_deg") for one in ("yaw", "tilt")]
    if verdict.metrics.get("probability_precise") is not None:
        named.append(("probability of being within 0.2° and 0.5 m", "probability_precise"))
    return [
        row(name, metric(verdict, key, printed(verdict, key)))
        for name, key in named
        if key in verdict.metrics
    ]


def metric_rows(verdict: Verdict) -> list[Row]:
    """Return every metric of a verdict."""
    rows = []
    for name, value in verdict.metrics.items():
        for label, text in descriptions.metric_rows({name: value}):
            plain = isinstance(value, int | float | np.generic) and not isinstance(value, bool | np.bool_)
            rows.append(row(label, Number(text, float(value), f"metrics.{name}") if plain else text))
    return rows


@dataclass(frozen=True)
class Candidate:
    """A candidate pose.

    Attributes:
        rank, yaw, shift, strength, overlap: as they are printed.
        share: its strength over the best's, percent.
        followed: whether it is the one that was followed.

    """

    rank: str
    yaw: str
    shift: str
    strength: str
    overlap: str
    share: float
    followed: bool


@dataclass(frozen=True)
class Candidates:
    """The candidate poses of the search.

    Attributes:
        rows: best first.
        left_out: how many more there are.
        what: "strength" or "score".
        margin: over the next distinct pose; None where it is not known.

    """

    rows: tuple[Candidate, ...]
    left_out: int
    what: str
    margin: Number | None


def candidates(pair: Pair) -> Candidates | None:
    """Return the candidate poses by what is judged; None where the matcher has none."""
    if pair.matches is None or not pair.matches.hypotheses:
        return None
    every = pair.matches.hypotheses
    best = every[:_MOST_HYPOTHESES]
    rows = descriptions.hypothesis_rows(pair)[: len(best)]
    values = [one.score if one.strength is None else one.strength for one in best]
    top = max([*values, 1e-12])
    known = all(one.strength is not None for one in best)
    margin = None
    verdict = pair.verdict
    if verdict is not None and verdict.metrics.get("hypothesis_margin") is not None and len(every) > 1:
        margin = metric(verdict, "hypothesis_margin", f"{printed(verdict, 'hypothesis_margin')} times")
    return Candidates(
        tuple(
            Candidate(
                texts[0],
                texts[1],
                texts[2],
                texts[3],
                texts[4],
                round(max(100.0 * value / top, 0.5), 1),
                number == 0,
            )
            for number, (texts, value) in enumerate(zip(rows, values, strict=True))
        ),
        len(every) - len(best),
        "strength" if known else "score",
        margin,
    )


def transform_rows(pair: Pair) -> list[Row]:
    """Return what the transform does, with the figures that stand in ``run.json``."""
    metrics = pair.verdict.metrics if pair.verdict is not None else {}
    rows = []
    for name, text in descriptions.transform_rows(pair):
        key = {"yaw": "yaw_deg", "tilt": "tilt_deg", "height offset found": "vertical_offset_m"}.get(name)
        if key is None or metrics.get(key) is None or pair.verdict is None:
            rows.append(row(name, text))
            continue
        head, unit, rest = text.partition("°" if key.endswith("_deg") else " m")
        rows.append(row(name, metric(pair.verdict, key, head + unit), rest))
    return rows


@dataclass(frozen=True)
class Matrix:
    """The transform in one frame: what it takes from where to where, and its four rows."""

    title: str
    text: str
    rows: str


@dataclass(frozen=True)
class Example:
    """A point before and after."""

    before: str
    after: str


def matrices(pair: Pair) -> tuple[Matrix, ...]:
    """Return the transform on file coordinates and in the work frame."""
    if pair.T_target_source is None:
        return ()
    chain = TransformChain.of(pair)
    exact = "" if chain.departure == 0 else f" It is a best fit here, off by up to {chain.departure:.3g} m."
    link = pair.source.link
    start = link.file_crs.name if link.file_crs is not None else "local coordinates"
    origins = "; ".join(
        f"{side.role} {', '.join(f'{value:.0f}' for value in side.link.origin)}"
        for side in (pair.source, pair.target)
    )
    work = pair.frame.crs.name if pair.frame.crs is not None else "local"
    return (
        Matrix(
            "On the coordinates as they stand in the files",
            f"Takes source coordinates (x, y, z, 1) in {start}: {descriptions.units_text(link)}, to "
            f"{descriptions.result_text(pair)}.{exact}",
            descriptions.matrix_text(chain.T_file),
        ),
        Matrix(
            f"In the work frame: {work}",
            f"Metres, on coordinates from which the origin of each cloud's work frame is subtracted first "
            f"({origins}).",
            descriptions.matrix_text(pair.T_target_source),
        ),
    )


def example(pair: Pair) -> Example | None:
    """Return a point before and after, to check a program by; None without a transform."""
    found = descriptions.worked_example(pair)
    if found is None:
        return None
    before, after = (", ".join(f"{value:.3f}" for value in point) for point in found)
    return Example(before, after)


@dataclass(frozen=True)
class StageRow:
    """A stage of the run.

    Attributes:
        tag, type: its names.
        seconds: its time, as printed.
        share: of the longest, percent.
        note: why it was skipped or failed; "" where it ran.
        options: in a line.

    """

    tag: str
    type: str
    seconds: str
    share: float
    note: str
    options: str


def stages(done: Sequence[Mapping[str, Any]]) -> tuple[StageRow, ...]:
    """Return the stages of a run as rows."""
    longest = max([float(entry.get("seconds", 0.0)) for entry in done] + [1e-9])
    return tuple(
        StageRow(
            str(entry.get("tag", "")),
            str(entry.get("type", "")),
            f"{float(entry.get('seconds', 0.0)):.2f} s",
            round(100.0 * float(entry.get("seconds", 0.0)) / longest, 1),
            "; ".join(f"{word}: {entry[word]}" for word in ("skipped", "failed") if entry.get(word)),
            descriptions.plain(
                {key: value for key, value in (entry.get("options") or {}).items() if value is not None}
            ),
        )
        for entry in done
    )


def longest(rows: Sequence[StageRow]) -> tuple[StageRow, ...]:
    """Return the stages that took longest, and those that did not do what they should, in their order."""
    slow = sorted(rows, key=lambda one: -one.share)[:_MOST_STAGES]
    return tuple(one for one in rows if one.note or (one in slow and one.share >= _LEAST_SHARE))


def frame_rows(pair: Pair) -> list[Row]:
    """Return the coordinate systems with their codes and units."""
    frames = frames_of(pair)
    names = {
        "source": "CRS of the source",
        "target": "CRS of the target",
        "result": "CRS of the result",
        "work": "work frame",
    }
    if pair.source is pair.target:
        del names["source"]
    known = {
        "source": pair.source.link.file_crs,
        "target": pair.target.link.file_crs,
        "result": (pair.frame.output or pair.target.link).file_crs,
        "work": pair.frame.crs,
    }
    return [row(name, _crs_text(frames[role], known[role])) for role, name in names.items()]


def _crs_text(frame: Mapping[str, Any], crs: CRS | None) -> str:
    units = list(dict.fromkeys(frame["units"]))
    unit = units[0] if len(units) == 1 else f"{frame['units'][0]} in plan, {frame['units'][2]} in height"
    if frame["crs"] is None:
        return f"local coordinates, {unit}"
    return f"{frame['crs']['name']} ({frame['crs']['authority'] or _codes_of_parts(crs)}), {unit}"


def _codes_of_parts(crs: CRS | None) -> str:
    """Return the codes of the parts of a compound CRS that has none of its own."""
    codes = [part.to_authority() for part in crs.sub_crs_list] if crs is not None else []
    return " + ".join(":".join(code) if code else "no code" for code in codes) or "no code"


def provenance_rows(facts: Mapping[str, Any], when: str) -> list[Row]:
    """Return when and how the run was started, what was read, and by which versions."""
    rows = [row("date", when)]
    if "command" in facts:
        rows.append(row("command line", facts["command"] or "none: run from Python, or as a pipeline there"))
    for one in facts.get("inputs") or []:
        name = Path(str(one.get("path", ""))).name
        rows.append(row(name, f"{one.get('bytes', 0):,} bytes, sha256 {one.get('sha256', '')}"))
    versions = facts.get("versions") or {}
    if versions:
        rows.append(row("versions", ", ".join(f"{name} {version}" for name, version in versions.items())))
    return rows

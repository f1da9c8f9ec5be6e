"""The report on a run: one HTML file that needs no other file and no network."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.types import Pair
from mtpcr_geo.core.version import __version__
from mtpcr_geo.core.wording import visible
from mtpcr_geo.crs import TransformChain
from mtpcr_geo.export import charts, descriptions, drawing
from mtpcr_geo.export.report import certainty

_PICTURE_SIDE = 1000

_STYLE = """
:root{--main:#1f6fb5;--quiet:#9fb4c7;--line:#d9dfe5;--soft:#f4f6f8;--text:#1d252c}
*{box-sizing:border-box}
body{font:15px/1.5 system-ui,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;color:var(--text);margin:0}
main{max-width:1180px;margin:0 auto;padding:24px}
h1{font-size:26px;margin:0 0 4px}
h2{font-size:19px;margin:36px 0 10px;border-bottom:1px solid var(--line);padding-bottom:4px}
h3{font-size:15px;margin:0 0 6px}
.verdict{border-left:8px solid;padding:12px 18px;margin:18px 0;background:var(--soft)}
.verdict b{font-size:21px;text-transform:capitalize}
.accepted{border-color:#1a9850}.doubtful{border-color:#e6a117}.refused{border-color:#d73027}
.none{border-color:#8a949e}
.grid{display:grid;grid-template-columns:repeat(auto-fit,minmax(440px,1fr));gap:18px;align-items:start}
.stack{display:grid;gap:18px;align-content:start}
.wide{grid-column:1/-1}
table{border-collapse:collapse;width:100%}
td,th{text-align:left;vertical-align:top;padding:4px 10px 4px 0;border-bottom:1px solid var(--line)}
th{font-weight:600}td:first-child{color:#51606d;white-space:nowrap}
td{overflow-wrap:anywhere}
figure{margin:0}figure img{width:100%;max-height:640px;object-fit:contain;display:block;background:#202228}
img.coarse{image-rendering:pixelated}
figcaption{font-size:13px;color:#51606d;margin-top:6px}
svg{width:100%;height:auto;display:block}
pre{background:var(--soft);padding:10px;overflow-x:auto;font-size:12.5px;line-height:1.45}
ul{margin:6px 0;padding-left:20px}
.key{display:inline-block;width:11px;height:11px;border-radius:2px;margin:0 4px 0 10px}
.small{font-size:13px;color:#51606d;white-space:normal}
table.checks td:last-child{white-space:nowrap}
table.checks td:first-child{max-width:560px;color:var(--text)}
.ok{color:#1a7a40}.warn{color:#a06c00;font-weight:600}.bad{color:#c0261c;font-weight:600}.none{color:#51606d}
details{margin:10px 0}summary{cursor:pointer;color:#51606d}
"""


def write_report(
    path: str | Path, pair: Pair, done: Sequence[Mapping[str, Any]], facts: Mapping[str, Any]
) -> None:
    """Write the report of a run, whatever state the run ended in.

    Args:
        path: the HTML file to write.
        pair: the registration, in any state.
        done: one entry a finished stage: type, tag, options, seconds, metadata, skipped, failed.
        facts: what holds for the run: versions, inputs (path, bytes, sha256), and what it wrote (files,
            withheld, forced).

    Raises:
        OutputError: if the file cannot be written.

    """
    names = f"{Path(pair.source.cloud.name).name} to {Path(pair.target.cloud.name).name}"
    sections = [
        _head(pair, names, facts.get("written")),
        _section("What was found", _found(pair)),
        _section("Pictures", _pictures(pair)),
        _section("How certain it is", _checks(pair)),
        _section("The transform", _transform(pair)),
        _section("The run", _run(done, facts)),
    ]
    html = (
        '<!DOCTYPE html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(names)}</title><style>{_STYLE}</style></head><body><main>"
        f"{''.join(sections)}</main></body></html>\n"
    )
    try:
        Path(path).write_text(visible(html), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write the report {path}: {error.strerror}") from error


def _head(pair: Pair, names: str, written: Mapping[str, Any] | None) -> str:
    verdict = pair.verdict
    if verdict is None:
        judged = '<div class="verdict none"><b>Not judged</b><p>The run ended before a verdict.</p></div>'
    else:
        reasons = "".join(f"<li>{escape(reason)}</li>" for reason in verdict.reasons)
        name, _, rest = verdict.headline.partition(":")
        judged = (
            f'<div class="verdict {verdict.name}"><p><b>{escape(name)}:</b>{escape(rest)}</p>'
            f"<p>{escape(descriptions.verdict_meaning(verdict))}</p><ul>{reasons}</ul>{_left(written)}</div>"
        )
    return f'<h1>{escape(names)}</h1><div class="small">registered with mtpcr_geo {__version__}</div>{judged}'


def _left(written: Mapping[str, Any] | None) -> str:
    """Say which files stand beside the report, and which do not and why."""
    if written is None:
        return ""
    return f'<p class="small">{escape(descriptions.written_text(written))}</p>'


def _found(pair: Pair) -> str:
    one_cloud = pair.source is pair.target
    parts = [
        f"<div><h3>{title}</h3>{_table(rows)}</div>"
        for title, rows in (
            ("Source: the cloud that moves", [] if one_cloud else descriptions.side_rows(pair.source)),
            ("Target: the cloud that stays", descriptions.side_rows(pair.target)),
            ("Transform", descriptions.transform_rows(pair)),
        )
        if rows
    ]
    return f'<div class="grid">{"".join(parts)}</div>'


def _pictures(pair: Pair) -> str:
    figures = []
    sides = [pair.target] if pair.source is pair.target else [pair.source, pair.target]
    for side in sides:
        if side.bev is not None:
            top, cell, _ = drawing.thinned(side.bev, _PICTURE_SIDE)
            picture = drawing.shaded_relief(top, cell)
            caption = (
                f"{side.role.capitalize()} seen from above: highest point per {side.bev.grid.cell:g} m cell, "
                "dark blue low to yellow high, lit from north-west; cells without points are dark."
            )
            figures.append(_figure(picture, caption))
    both = pair.source.bev is not None and pair.target.bev is not None
    if both and pair.matches is not None and len(pair.matches.source_px):
        caption = (
            "What was matched: source left, target right. "
            + _key(drawing.GOOD_RGB, "agrees with the transform")
            + _key(drawing.HELD_OUT_RGB, "agrees, and was held out from the solve")
            + _key(drawing.BAD_RGB, "does not agree")
        )
        if pair.T_target_source is None:
            caption = "What was matched: source left, target right. No transform was found from it."
        figures.append(_figure(drawing.matches_picture(pair), caption, wide=True))
    if both and pair.T_target_source is not None:
        source, target = drawing.common_rasters(pair)
        overlay = (
            "The source laid over the target, where they overlap: if it fits, the source's edges run along "
            "the target's. " + _key(drawing.SOURCE_RGB, "source") + _key(drawing.TARGET_RGB, "target")
        )
        figures.append(_figure(drawing.edge_overlay(source, target), overlay))
        board = (
            "Source (orange) and target (blue) in turn, in squares of 20 m: "
            "roofs, kerbs and banks must continue across the borders."
        )
        figures.append(_figure(drawing.checkerboard(source, target), board))
    figures += certainty.rivals_figures(pair, _figure, _key)
    if not figures:
        return "<p>No raster was made.</p>"
    return f'<div class="grid">{"".join(figures)}</div>'


def _checks(pair: Pair) -> str:
    checks = certainty.checks_table(pair)
    parts = [certainty.error_map(pair, _figure), certainty.candidates_chart(pair)]
    if pair.tie_points is not None and pair.T_target_source is not None and len(pair.tie_points.target):
        parts += certainty.tie_charts(pair, _key)
    parts = [part for part in parts if part]
    if not parts and not checks:
        return "<p>There is nothing to judge the result by.</p>"
    return f'<div class="wide">{checks}</div><div class="grid">{"".join(parts)}</div>'


def _transform(pair: Pair) -> str:
    if pair.T_target_source is None:
        return "<p>No transform was found.</p>"
    departure = TransformChain.of(pair).departure
    exact = "" if departure == 0 else f" It is a best fit here, off by up to {departure:.3g} m."
    source = pair.source.link
    start = source.file_crs.name if source.file_crs is not None else "local coordinates"
    parts = [
        "<h3>On the coordinates as they stand in the files</h3>",
        f"<p>Takes source coordinates (x, y, z, 1) in {escape(start)}: "
        f"{escape(descriptions.units_text(source))}, "
        f"to {escape(descriptions.result_text(pair))}.{exact}</p>",
        f"<pre>{descriptions.matrix_text(TransformChain.of(pair).T_file)}</pre>",
    ]
    example = descriptions.worked_example(pair)
    if example is not None:
        before, after = (", ".join(f"{value:.3f}" for value in point) for point in example)
        parts.append(
            f"<p>Worked example, the middle of the source: <code>{before}</code> becomes "
            f"<code>{after}</code>. Use it to check a program to which you give the matrix.</p>"
        )
    origins = "; ".join(
        f"{side.role} {', '.join(f'{value:.0f}' for value in side.link.origin)}"
        for side in (pair.source, pair.target)
    )
    work = pair.frame.crs.name if pair.frame.crs is not None else "local"
    parts += [
        f"<h3>In the work frame: {escape(work)}</h3>",
        "<p>Metres, on coordinates from which the origin of each cloud's work frame is subtracted first "
        f"({escape(origins)}).</p><pre>{descriptions.matrix_text(pair.T_target_source)}</pre>",
    ]
    return "".join(parts)


def _run(done: Sequence[Mapping[str, Any]], facts: Mapping[str, Any]) -> str:
    parts = []
    if done:
        seconds = [float(entry.get("seconds", 0.0)) for entry in done]
        slow = sorted(range(len(done)), key=lambda i: -seconds[i])[:12]
        shown = sorted(slow)
        chart = charts.bars(
            [seconds[i] for i in shown],
            [str(done[i].get("tag", "")) for i in shown],
            [f"{seconds[i]:.2f} s" for i in shown],
        )
        parts.append(f"<div><h3>Time: {sum(seconds):.1f} s up to this report</h3>{chart}</div>")
    versions = facts.get("versions") or {}
    if versions:
        rows = [(str(name), str(version)) for name, version in versions.items()]
        parts.append(f"<div><h3>Versions</h3>{_table(rows)}</div>")
    inputs = facts.get("inputs") or []
    if inputs:
        rows = [
            (
                Path(str(one.get("path", ""))).name,
                f"{one.get('bytes', 0):,} bytes, sha256 {one.get('sha256', '')}",
            )
            for one in inputs
        ]
        parts.append(f'<div class="wide"><h3>Inputs</h3>{_table(rows)}</div>')
    rows = [(str(entry.get("tag", "")), _stage_note(entry)) for entry in done]
    if rows:
        parts.append(f'<div class="wide"><h3>Stages and their options</h3>{_table(rows)}</div>')
    return f'<div class="grid">{"".join(parts)}</div>' if parts else "<p>Nothing was recorded.</p>"


def _stage_note(entry: Mapping[str, Any]) -> str:
    notes = [str(entry.get("type", ""))]
    notes += [f"{word}: {entry[word]}" for word in ("skipped", "failed") if entry.get(word)]
    options = {key: value for key, value in (entry.get("options") or {}).items() if value is not None}
    if options:
        notes.append(descriptions.plain(options))
    return "; ".join(notes)


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><td>{escape(name)}</td><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"


def _figure(picture: drawing.Picture, caption_html: str, wide: bool = False) -> str:
    side = _PICTURE_SIDE + 400 if wide else _PICTURE_SIDE
    coarse = ' class="coarse"' if max(picture.shape[:2]) < side // 2 else ""
    data = base64.b64encode(drawing.jpeg(drawing.fit(picture, side))).decode("ascii")
    image = f'<img{coarse} alt="" src="data:image/jpeg;base64,{data}">'
    return f"<figure{' class=wide' if wide else ''}>{image}<figcaption>{caption_html}</figcaption></figure>"


def _key(colour: Sequence[int], text: str) -> str:
    red, green, blue = colour
    return f'<span class="key" style="background:rgb({red},{green},{blue})"></span>{escape(text)}'

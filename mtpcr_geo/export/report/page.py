"""The report on a run: one HTML file that needs no other file and no network."""

from __future__ import annotations

import base64
import datetime
import hashlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.system import opencv_in_one_thread, usable_cores
from mtpcr_geo.core.types import Check, Pair, Verdict
from mtpcr_geo.core.version import __version__
from mtpcr_geo.core.wording import visible
from mtpcr_geo.export import descriptions
from mtpcr_geo.export.report import facts as told
from mtpcr_geo.export.report import figures, ties
from mtpcr_geo.export.report.compiled import ENVIRONMENT, TEMPLATE
from mtpcr_geo.export.report.pictures import Overlay


def write_report(
    path: str | Path,
    pair: Pair,
    done: Sequence[Mapping[str, Any]],
    facts: Mapping[str, Any],
    pictures: Mapping[str, Any] | None = None,
) -> None:
    """Write the report of a run, whatever state the run ended in.

    Args:
        path: the HTML file to write.
        pair: the registration, in any state.
        done: one entry a finished stage: type, tag, options, seconds, metadata, skipped, failed.
        facts: what holds for the run: versions, inputs (path, bytes, sha256), the command line that
            started it (None where none did), and what it wrote (files, withheld, forced).
        pictures: those of the pair, see `pictures_of`; drawn here if None.

    Raises:
        OutputError: if the file cannot be written.

    """
    drawn = pictures_of(pair) if pictures is None else pictures
    html = TEMPLATE.render({**_content(pair, done, facts), **drawn})
    try:
        Path(path).write_text(visible(html) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write the report {path}: {error.strerror}") from error


def _content(pair: Pair, done: Sequence[Mapping[str, Any]], facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the template shows beside the pictures."""
    now = datetime.datetime.now(datetime.UTC)
    style, script = (_part(name) for name in ("style.css", "swipe.js"))
    written = facts.get("written")
    one_cloud = pair.source is pair.target
    sides = [] if one_cloud else [("Source: the cloud that moves", pair.source)]
    sides.append(("Target: the cloud that stays", pair.target))
    return {
        "style": style,
        "script": script,
        "script_hash": "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii"),
        "names": f"{Path(pair.source.cloud.name).name} to {Path(pair.target.cloud.name).name}",
        "version": __version__,
        "date": now.date().isoformat(),
        "verdict": _verdict(pair),
        "written": descriptions.written_text(written) if written is not None else "",
        "accuracy": told.accuracy(pair.verdict),
        "accuracy_title": _accuracy_title(pair.verdict),
        "rotation": told.rotation_rows(pair.verdict),
        "checks": [_check(one) for one in (pair.verdict.checks if pair.verdict is not None else ())],
        "metrics": told.metric_rows(pair.verdict) if pair.verdict is not None else [],
        "candidates": told.candidates(pair),
        "solved": pair.T_target_source is not None,
        "transform": told.transform_rows(pair),
        "matrices": told.matrices(pair),
        "example": told.example(pair),
        "sides": [
            (title, [told.row(name, text) for name, text in descriptions.side_rows(side)])
            for title, side in sides
        ],
        "stages": told.stages(done),
        "longest": told.longest(told.stages(done)),
        "total": f"{sum(float(entry.get('seconds', 0.0)) for entry in done):.1f} s",
        "provenance": [
            *told.provenance_rows(facts, now.strftime("%Y-%m-%d %H:%M UTC")),
            *told.frame_rows(pair),
        ],
        "both_keys": figures.BOTH_KEYS,
    }


def pictures_of(pair: Pair) -> dict[str, Any]:
    """Return the pictures and charts of a report, by their names in it, as far as the run came."""
    both = pair.source.bev is not None and pair.target.bev is not None
    found: dict[str, Any] = dict.fromkeys(("zoom", "swipe", "difference"))
    found |= {"sections": (), "patches": (), "reliefs": ()}
    of_pair: dict[str, Callable[[Pair], Any]] = {
        "rivals": figures.rivals,
        "ties": ties.tie_plots,
        "matched": figures.matched,
        "error_map": figures.error_map,
    }
    of_overlay: dict[str, Callable[[], Any]] = {}
    if both and pair.T_target_source is not None:
        of_pair = {"swipe": figures.swipe, **of_pair}
        overlay = Overlay(pair)
        if overlay.shared.any():
            of_overlay = {
                "zoom": partial(figures.overlap_zoom, overlay),
                "difference": partial(figures.difference, overlay),
                "sections": partial(figures.cross_sections, overlay),
                "patches": partial(figures.patches, overlay),
            }
    else:
        of_pair["reliefs"] = figures.reliefs
    with ThreadPoolExecutor(usable_cores()) as threads, opencv_in_one_thread():
        drawn = {name: threads.submit(draw) for name, draw in of_overlay.items()}
        drawn |= {name: threads.submit(draw, pair) for name, draw in of_pair.items()}
        return found | {name: future.result() for name, future in drawn.items()}


def _verdict(pair: Pair) -> dict[str, Any] | None:
    verdict = pair.verdict
    if verdict is None:
        return None
    head, _, rest = verdict.headline.partition(":")
    return {
        "name": verdict.name,
        "head": head,
        "rest": rest,
        "meaning": descriptions.verdict_meaning(pair),
        "reasons": verdict.reasons,
    }


def _accuracy_title(verdict: Verdict | None) -> str:
    return (
        "accuracy" if verdict is not None and verdict.name == "accepted" else "accuracy, if the pose is right"
    )


def _check(check: Check) -> dict[str, str]:
    return {
        "name": check.name,
        "value": check.value,
        "wanted": check.wanted,
        "meaning": check.meaning,
        "status": check.status,
        "css": told.STATUS_CLASS[check.status],
    }


@cache
def _part(name: str) -> str:
    """Return a part of the page that is no template."""
    assert ENVIRONMENT.loader is not None
    return ENVIRONMENT.loader.get_source(ENVIRONMENT, name)[0].strip()

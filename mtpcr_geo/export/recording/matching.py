"""What a recording shows of keypoint matching: images, keypoints, the sweep, FOCUS before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import rerun as rr

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.export import drawing
from mtpcr_geo.export.recording import bars
from mtpcr_geo.export.recording.budget import Budget

_KEYPOINT_RGB = (255, 190, 60)


@dataclass(frozen=True)
class Pen:
    """How to write into a recording.

    Attributes:
        log: logs something under an entity path.
        image: logs a picture under an entity path, shrunk to the budget; returns by how much.
        bars: logs a table of bars under an entity path, given its head.
        budget: how much may be logged.

    """

    log: Callable[[str, Any], None]
    image: Callable[[str, drawing.Picture], float]
    bars: Callable[[str, Sequence[str], Sequence[bars.Bar]], None]
    budget: Budget


def log_appearance(pen: Pen, side: Side) -> None:
    """Log the grey image of heights and the image that is matched: before and after enhancement."""
    if side.appearance is None:
        return
    pen.image(f"enhancement/{side.role}/before", side.appearance.plain)
    pen.image(f"enhancement/{side.role}/after", side.appearance.image)


def log_keypoints(pen: Pen, pair: Pair) -> None:
    """Log all keypoints, and those matched, on the image in which they were found."""
    matches = pair.matches
    if matches is None:
        return
    for side, found, used in (
        (pair.source, matches.source_keypoints, matches.source_px),
        (pair.target, matches.target_keypoints, matches.target_px),
    ):
        if found is None or side.appearance is None:
            continue
        root = f"keypoints/{side.role}"
        scale = pen.image(f"{root}/image", side.appearance.image)
        for name, px, rgb, radius in (
            ("all", found, _KEYPOINT_RGB, 1.5),
            ("matched", used, drawing.UNJUDGED_RGB, 3.0),
        ):
            # rerun's pixels have their centres at halves
            at = (px[:: -(-len(px) // pen.budget.keypoints) or 1] + 0.5) * scale
            pen.log(
                f"{root}/{name}",
                rr.Points2D(at, colors=rgb, radii=rr.Radius.ui_points(radius), draw_order=10.0 + radius),
            )


def log_sweep(pen: Pen, pair: Pair) -> None:
    """Log how many matches agreed in every orientation of the source."""
    reported = pair.matches.report if pair.matches is not None else {}
    turns = reported.get("turns_deg")
    if not turns or len(turns) < 2:
        return
    for name in ("agreeing", "matches"):
        counts = reported[f"turn_{name}"]
        shown = [
            bars.Bar((f"{turn:g}°", str(count)), float(count))
            for turn, count in zip(turns, counts, strict=True)
        ]
        pen.bars(f"sweep/{name}", ("rotation", "matches"), shown)


def log_focus(pen: Pen, pair: Pair) -> None:
    """Log the matches before and after FOCUS, on both rasters beside each other."""
    matches = pair.matches
    if matches is None or matches.before_focus is None:
        return
    for name, one in (("before", matches.before_focus), ("after", matches)):
        bare = pair.with_(matches=one, tie_points=None, T_target_source=None)
        picture, ends, colours, _ = drawing.match_lines(bare)
        at: Floats = (ends + 0.5) * pen.image(f"focus/{name}/image", picture)
        lines = rr.LineStrips2D(at, colors=colours, radii=rr.Radius.ui_points(0.8), draw_order=20.0)
        pen.log(f"focus/{name}/lines", lines)

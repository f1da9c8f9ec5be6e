"""The figures of a report, each with what it shows in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.export import charts, drawing
from mtpcr_geo.export.report import pictures
from mtpcr_geo.export.report.facts import Number, Words, metric
from mtpcr_geo.export.report.pictures import Overlay
from mtpcr_geo.export.report.rasters import Window
from mtpcr_geo.export.report.rivals import rival_pose
from mtpcr_geo.export.report.sections import Section, picture_of, sections_of
from mtpcr_geo.export.report.shown import Box, Key, Plot, Shown, key, shown, ticks
from mtpcr_geo.verdict.findings import rival_text

MOST_RIVALS = 2
BOTH_KEYS = (
    Key("#9a9a9a", "grey: equal heights"),
    key(drawing.SOURCE_RGB, "source higher"),
    key(drawing.TARGET_RGB, "target higher"),
    Key("#3a3a3a", "dim: seen by one alone"),
)
SIDE_KEYS = (key(drawing.SOURCE_RGB, "source"), key(drawing.TARGET_RGB, "target"))
_GROUND_CSS, _OTHER_CSS = "#4c78a8", "#b9c6d3"
_ERROR_POINTS = 200_000
_FEWEST_GROUND = 100


@dataclass(frozen=True)
class Difference:
    """The map of height differences and its histogram."""

    map: Shown
    histogram: Plot


@dataclass(frozen=True)
class BeforeAfter:
    """Two pictures of one extent, to be swiped."""

    before: Shown
    after: Shown
    caption: str


def overlap_zoom(overlay: Overlay) -> Shown:
    """Show the part of the overlap in which one sees best whether both clouds fit."""
    picture, cell = overlay.zoom()
    verdict = overlay.pair.verdict
    refused = verdict is not None and verdict.name == "refused"
    pose = "the pose that is refused" if refused else "the pose found"
    return shown(
        picture,
        f"Heights of both clouds in a part of their overlap under {pose}: grey where they are equal, orange "
        "or blue where one of them is higher.",
        cell=cell,
        keys=BOTH_KEYS,
        caption=f"Heights of both clouds under {pose}, light is high, where most stands in the overlap. "
        "Outlines that are grey lie on each other; a shift shows as an orange fringe on one side and a blue "
        "one on the other.",
    )


def swipe(pair: Pair) -> BeforeAfter:
    """Show the source over the target before and after."""
    found = pictures.before_and_after(pair)
    before = (
        "where its own coordinates put it"
        if found.as_it_lay
        else "turned as in its own coordinates and put where it belongs, since these say nothing of the place"
    )
    keys = (Key("#c06a20", "source"), Key("#8a8a8a", "target"))
    return BeforeAfter(
        shown(found.before, f"The source over the target before: {before}.", cell=found.cell, title="before"),
        shown(
            found.after,
            "The source over the target after the registration.",
            cell=found.cell,
            title="after",
            keys=keys,
        ),
        f"Relief of the source (orange) over the target (grey), north up. Before: the source {before}. "
        f"Roads, ridges "
        "and rows of trees must run on from one into the other after.",
    )


def difference(overlay: Overlay) -> Difference | None:
    """Show by how much the source lies above the target; None where nothing overlaps."""
    pair, off = overlay.pair, overlay.difference
    known = off[np.isfinite(off)].astype(np.float64)
    if not len(known):
        return None
    ground = -overlay.ground.step
    most = pictures.difference_limit(ground if len(ground) >= _FEWEST_GROUND else known)
    box = overlay.box
    off = off[box.rows, box.columns]
    boxes = tuple(
        _box(patch.window, box, str(number)) for number, patch in enumerate(overlay.patches(), start=1)
    )
    names = (f"below −{most:g} m", "equal", f"above {most:g} m")
    keys = tuple(Key(css, name) for css, name in zip(("#2166ac", "#f7f7f7", "#b2182b"), names, strict=True))
    picture = pictures.difference_colours(off, most)
    image = shown(
        pictures.enlarged(picture, 900),
        f"Map of the height differences in the overlap, from {-most:g} m in blue to {most:g} m in red.",
        cell=overlay.cell * picture.shape[1] / pictures.enlarged(picture, 900).shape[1],
        exact=True,
        keys=keys,
        boxes=boxes,
        caption="Lowest height of the source less that of the target in each cell of "
        f"{overlay.cell:g} m that both fill. One colour all over means an offset in height, opposite "
        f"colours at opposite "
        "ends a tilt, pairs of lines along walls a shift; single lines are walls or trees that one of them "
        "does not see." + (" The numbers are the patches below." if boxes else ""),
    )
    return Difference(image, _ground_histogram(pair, ground, overlay.ground.cell, known, most))


def _ground_histogram(pair: Pair, ground: Floats, cell: float, known: Floats, most: float) -> Plot:
    """Show the height differences of the ground; those of all cells where no ground is seen by both."""
    if len(ground):
        reach = max(most, float(np.percentile(np.abs(ground), 98)) * 1.1)
        what, css, values = "cells of ground", _GROUND_CSS, ground
        middle = float(np.median(ground))
        spread = 1.4826 * float(np.median(np.abs(ground - middle)))
        agreeing = int((np.abs(ground) < pictures.STATED_M).sum())
        caption: Words = (
            "The same of the ground alone, as the check “ground heights” compares it: ",
            _figure(pair, "ground_agreeing", f"{agreeing:,}"),
            " of ",
            _figure(pair, "ground_cells", f"{len(ground):,}"),
            f" cells of {cell:g} m in which both see the ground agree within {pictures.STATED_M:g} m; median "
            f"{middle + 0.0:+.3f} m, robust standard deviation {spread:.3f} m.",
        )
    else:
        reach, what, css, values = most, "cells", _OTHER_CSS, known
        caption = ("Of all cells: ground is seen by both in none.",)
    chart = charts.histogram(values, [(np.ones(len(values), bool), css)], -reach, reach, what)
    return Plot(
        "Ground: source less target" if len(ground) else "Source less target",
        chart.svg,
        f"Histogram of the height differences, in {what}.",
        caption,
        (Key(css, what),),
        ticks(chart.low, chart.high, 5, "m"),
        f"{chart.top:,.0f}",
    )


def _figure(pair: Pair, name: str, text: str) -> str | Number:
    """Return a count as a figure of the verdict, where it has that."""
    verdict = pair.verdict
    return text if verdict is None or verdict.metrics.get(name) is None else metric(verdict, name, text)


def cross_sections(overlay: Overlay) -> tuple[Shown, ...]:
    """Show both clouds from the side, along and across the overlap."""
    return tuple(
        _section_shown(overlay.pair, one)
        for one in sections_of(overlay.pair, *drawing.common_rasters(overlay.pair))
    )


def _section_shown(pair: Pair, section: Section) -> Shown:
    whole = pair.source.complete and pair.target.complete
    points = (
        "all points of both clouds" if whole else "the points of both clouds that the run kept, a sample,"
    )
    stretched = (
        "" if section.exaggeration == 1 else f" Heights are drawn {section.exaggeration} times larger."
    )
    link = pair.target.link
    T_work = transforms.inverse(pair.target.T_level_work)
    ends = np.column_stack([np.vstack([section.start, section.end]), np.full(2, section.low_m)])
    a, b = link.to_file(transforms.apply(T_work, ends))[:, :2]
    floor = float(link.to_file(transforms.apply(T_work, ends))[0, 2])
    unit = float(
        np.diff(link.to_file(transforms.apply(T_work, ends[:1] + [[0, 0, 0], [0, 0, 1.0]]))[:, 2])[0]
    )
    high = floor + unit * (section.high_m - section.low_m)
    return shown(
        picture_of(section),
        f"Cross-section {section.name} the overlap: points of the source in orange, of the target in blue.",
        side=1800,
        exact=True,
        title=f"{section.name.capitalize()} the overlap",
        keys=SIDE_KEYS,
        x_ticks=ticks(0.0, section.length_m, 8, "m"),
        y_ticks=ticks(floor, high, 5) if unit > 0 else (),
        caption=f"{points.capitalize()} in a slab {section.thickness_m:.2g} m thick: "
        f"{len(section.source):,} of the source "
        f"as registered, {len(section.target):,} of the target; from {_place(a)} to {_place(b)}.{stretched}",
    )


def _place(xy: Floats) -> str:
    return ", ".join(f"{value:.1f}" for value in xy)


def patches(overlay: Overlay) -> tuple[Shown, ...]:
    """Show the squares of the overlap where heights agree best, as in the middle, and worst."""
    found = []
    for number, patch in enumerate(overlay.patches(), start=1):
        picture, cell = overlay.zoom(patch.window, 420)
        side = (patch.window.columns.stop - patch.window.columns.start) * overlay.cell
        found.append(
            shown(
                picture,
                f"Heights of both clouds in the patch where they agree {_WHERE[patch.name]}.",
                cell=cell,
                title=f"{number}. {patch.name}",
                caption=f"{side:.0f} m wide; lowest heights differ by {patch.off_m:.2f} m in the median.",
            )
        )
    return tuple(found)


_WHERE = {"best": "best", "median": "as in the median of all patches", "worst": "worst"}


def rivals(pair: Pair) -> tuple[Shown, ...]:
    """Show the overlap under the pose found and under each rival that the verdict names."""
    verdict = pair.verdict
    if verdict is None or not verdict.rivals or pair.tie_points is None or pair.T_target_source is None:
        return ()
    if pair.source.bev is None or pair.target.bev is None or not len(pair.tie_points):
        return ()
    mapped = pair.frame.crs is not None
    poses = [("The pose found", pair.T_target_source)]
    for number, rival in enumerate(verdict.rivals[:MOST_RIVALS], start=1):
        text = f"Rival {number}: {rival_text(rival, mapped)} (margin {rival.margin:.2f})"
        poses.append((text, rival_pose(pair, rival)))
    found = []
    for text, T in poses:
        overlay = Overlay(pair.with_(T_target_source=T))
        picture, cell = overlay.zoom()
        name = text.partition(":")[0]
        alt = f"Heights of both clouds in their overlap under {name[:1].lower()}{name[1:]}."
        found.append(shown(picture, alt, cell=cell, keys=BOTH_KEYS, caption=f"{text}."))
    return tuple(found)


def error_map(pair: Pair) -> Shown | None:
    """Show what 95 % of the errors in plan stay below over the source; None where none is claimed."""
    verdict = pair.verdict
    if verdict is None or verdict.uncertainty is None or pair.T_target_source is None:
        return None
    if verdict.name == "refused":
        return None
    picture, cell, low, high = expected_error_picture(pair, verdict.uncertainty)
    return shown(
        picture,
        f"Expected error over the source's extent, from {low:.2f} m in green to {high:.2f} m in red.",
        cell=cell,
        exact=True,
        keys=(key(drawing.GOOD_RGB, f"{low:.2f} m"), key(drawing.BAD_RGB, f"{high:.2f} m")),
        caption="What 95 % of the errors in plan stay below, over the source's extent, in the target's "
        "frame, at the median height of its points.",
    )


def expected_error_picture(
    pair: Pair, uncertainty: Uncertainty, side: int = 400
) -> tuple[drawing.Picture, float, float, float]:
    """Draw what 95 % of the errors in plan stay below at the source's points.

    Args:
        pair: with a transform.
        uncertainty: of that.
        side: pixels along the longer side at most; fewer where points are sparse.

    Returns:
        The picture (h, w, 4), north up, the metres of a pixel, and the least and greatest value, metres.

    """
    assert pair.T_target_source is not None
    some = pair.source.sample[:: max(1, len(pair.source.sample) // _ERROR_POINTS)]
    moved = transforms.apply(pair.T_target_source, some)
    level: Floats = (moved - uncertainty.pivot) @ uncertainty.R_level.T
    low, high = transforms.bounds(level[:, :2])
    spacing = float(np.sqrt(np.prod(high - low) / max(len(level), 1)))
    cell = max(float((high - low).max()) / side, 2.0 * spacing, 1e-6)
    width, height = (int(size) + 1 for size in np.floor((high - low) / cell))
    grid = Grid(float(low[0]), float(low[1]) + height * cell, cell, width, height)
    column, row = grid.cells(level)
    row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
    _, first = np.unique(row * width + column, return_index=True)
    # all at one height: the map shows how it grows with the distance, not what stands where
    at = level[first]
    at[:, 2] = np.median(level[:, 2])
    within, _ = uncertainty.within_95(at @ uncertainty.R_level + uncertainty.pivot)
    least, most = float(within.min()), float(within.max())
    picture = np.zeros((height, width, 4), np.uint8)
    colours = drawing.residual_colours(within, least, max(most, least + 1e-9))
    picture[row[first], column[first], :3] = colours
    picture[row[first], column[first], 3] = 255
    return picture, cell, least, most


def reliefs(pair: Pair) -> tuple[Shown, ...]:
    """Show each cloud from above, for runs that found no transform."""
    sides: list[Side] = [pair.target] if pair.source is pair.target else [pair.source, pair.target]
    found = []
    for side in sides:
        if side.bev is None:
            continue
        picture, cell = pictures.relief(side.bev)
        found.append(
            shown(
                picture,
                f"The {side.role} seen from above.",
                cell=cell,
                caption=f"{side.role.capitalize()} seen from above: highest point of each cell, dark blue "
                f"low to yellow "
                "high, lit from north-west.",
            )
        )
    return tuple(found)


def matched(pair: Pair) -> Shown | None:
    """Show what was matched in both rasters; None where nothing was."""
    if (
        pair.source.bev is None
        or pair.target.bev is None
        or pair.matches is None
        or not len(pair.matches.source_px)
    ):
        return None
    keys: tuple[Key, ...] = (
        key(drawing.GOOD_RGB, "agrees with the transform"),
        key(drawing.HELD_OUT_RGB, "agrees, and was held out from the solve"),
        key(drawing.BAD_RGB, "does not agree"),
    )
    caption = "What was matched: source left, target right, at most 150 lines."
    if pair.T_target_source is None:
        caption, keys = f"{caption} No transform was found from it.", ()
    return shown(
        drawing.matches_picture(pair),
        "Both rasters beside each other, with lines between the places that were matched.",
        side=1400,
        caption=caption,
        keys=keys,
    )


def _box(window: Window, within: Window, text: str) -> Box:
    """Return a window as a rectangle over the picture of another that holds it."""
    height = within.rows.stop - within.rows.start
    width = within.columns.stop - within.columns.start
    return Box(
        round(100.0 * (window.columns.start - within.columns.start) / width, 2),
        round(100.0 * (window.rows.start - within.rows.start) / height, 2),
        round(100.0 * (window.columns.stop - window.columns.start) / width, 2),
        round(100.0 * (window.rows.stop - window.rows.start) / height, 2),
        text,
    )

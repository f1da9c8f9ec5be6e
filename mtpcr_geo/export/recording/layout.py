"""The layout of a recording in the rerun viewer: its blueprint, built from what was recorded."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mtpcr_geo.core.arrays import Floats

TIMELINE = "stage"


@dataclass(eq=False)
class Recorded:
    """What a recording holds, as far as the layout depends on it.

    Attributes:
        paths: entities that hold something.
        bounds: (2, 3) lowest and highest coordinates by entity root, metres, for the first view.
        images: (width, height) in pixels by entity root.

    """

    paths: set[str] = field(default_factory=set)
    bounds: dict[str, Floats] = field(default_factory=dict)
    images: dict[str, tuple[int, int]] = field(default_factory=dict)

    def has(self, root: str) -> bool:
        """Return whether something was recorded at or below an entity."""
        return any(path == root or path.startswith(root + "/") for path in self.paths)


def layout(recorded: Recorded) -> Any:
    """Build the blueprint: pictures in tabs at the left, verdict and stages at the right."""
    import rerun.blueprint as rrb

    tabs = [
        _overview(recorded),
        _rasters(recorded),
        _matches(recorded),
        _keypoints(recorded),
        _focus(recorded),
        _ties(recorded),
        _inputs(recorded),
        _map(recorded),
    ]
    shown = [tab for tab in tabs if tab is not None]
    texts = rrb.Vertical(
        rrb.Tabs(
            rrb.TextDocumentView(origin="summary", name="Verdict"),
            rrb.TextDocumentView(origin="run", name="Options and versions"),
        ),
        rrb.Tabs(
            rrb.TextLogView(origin="stages", name="Stages", columns=_log_columns()),
            rrb.TimeSeriesView(origin="seconds", name="Seconds a stage"),
        ),
        row_shares=[3, 1],
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*shown, active_tab=0), texts, column_shares=[5, 2]) if shown else texts,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def _log_columns() -> Any:
    import rerun.blueprint as rrb

    return rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["LogLevel", "Body"])


def _overview(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    if not recorded.has("levelled"):
        return None
    before = _space(recorded, "levelled", "Before: both levelled, each in its own frame")
    matches = _flat(recorded, "matches", "Matches: source left, target right")
    if not recorded.has("aligned"):
        return rrb.Horizontal(before, *([matches] if matches else []), name="Overview")
    after = _space(recorded, "aligned", "After: source orange, target blue", hide=("tie_points", "links"))
    below = rrb.Horizontal(before, matches) if matches else before
    return rrb.Vertical(after, below, row_shares=[3, 2], name="Overview")


def _rasters(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    kinds = (
        ("relief", "shaded heights"),
        ("bandpass", "band-passed heights, as matched"),
        ("height", "heights"),
    )
    grids = []
    for kind, title in kinds:
        views = [
            _flat(recorded, f"bev/{role}/{kind}", f"{role.capitalize()}: {title}")
            for role in ("source", "target")
        ]
        shown = [view for view in views if view is not None]
        if shown:
            grids.append(rrb.Horizontal(*shown, name=title.capitalize()))
    return rrb.Tabs(*grids, name="Rasters") if grids else None


def _matches(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    matches = _flat(recorded, "matches", "Matches: agreeing green, held out blue, disagreeing red")
    if matches is None:
        return None
    if not recorded.has("hypotheses"):
        return rrb.Horizontal(matches, name="Matches")
    below = rrb.Horizontal(
        rrb.BarChartView(origin="hypotheses/scores", name="Strength of each candidate pose"),
        rrb.TextDocumentView(origin="hypotheses/table", name="Candidate poses"),
    )
    return rrb.Vertical(matches, below, row_shares=[3, 1], name="Matches")


def _keypoints(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    grids = []
    for title, paths in (
        ("Keypoints", [(f"keypoints/{role}", f"{role.capitalize()}: keypoints; matched ones large")
                       for role in ("source", "target")]),
        ("Enhancement", [(f"enhancement/{role}/{when}", f"{role.capitalize()} {when} enhancement")
                         for role in ("source", "target") for when in ("before", "after")]),
    ):  # fmt: skip
        views = [view for path, name in paths if (view := _flat(recorded, path, name)) is not None]
        if views:
            grids.append(rrb.Grid(*views, grid_columns=2, name=title))
    if recorded.has("sweep"):
        charts = [
            rrb.BarChartView(origin=f"sweep/{what}", name=f"{title} by rotation of the source, degrees")
            for what, title in (("agreeing", "Agreeing matches"), ("matches", "Matches"))
        ]
        grids.append(rrb.Vertical(*charts, name="Sweep"))
    return rrb.Tabs(*grids, name="Keypoints") if grids else None


def _focus(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    views = [_flat(recorded, f"focus/{when}", f"Matches {when} FOCUS") for when in ("before", "after")]
    shown = [view for view in views if view is not None]
    return rrb.Vertical(*shown, name="FOCUS") if shown else None


def _ties(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    if not recorded.has("aligned/tie_points"):
        return None
    space = _space(
        recorded, "aligned", "Tie points by residual: green fits, red does not", hide=("source", "links")
    )
    chart = rrb.BarChartView(origin="residuals", name="Tie points by residual in centimetres")
    return rrb.Vertical(space, chart, row_shares=[3, 1], name="Tie points")


def _inputs(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    views = [
        _space(recorded, f"input/{role}", f"{role.capitalize()} as read, by height", away=1.5)
        for role in ("source", "target")
        if recorded.has(f"input/{role}")
    ]
    return rrb.Horizontal(*views, name="Input") if views else None


def _map(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    return rrb.MapView(origin="map", name="Map") if recorded.has("map") else None


def _space(recorded: Recorded, origin: str, name: str, hide: tuple[str, ...] = (), away: float = 1.0) -> Any:
    """Return a 3D view that looks from the south, half from above, at all that is there."""
    import rerun.blueprint as rrb

    contents = ["$origin/**", *(f"- $origin/{path}/**" for path in hide)]
    eye = None
    bounds = recorded.bounds.get(origin)
    if bounds is not None:
        middle = bounds.mean(axis=0)
        width = float(np.linalg.norm(bounds[1, :2] - bounds[0, :2])) or 10.0
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=middle + away * width * np.array([0.0, -0.46, 0.5]),
            look_target=middle - width * np.array([0.0, 0.03, 0.0]),
            eye_up=(0.0, 0.0, 1.0),
        )
    return rrb.Spatial3DView(
        origin=origin,
        contents=contents,
        name=name,
        background=(18, 20, 24),
        line_grid=False,
        eye_controls=eye,
    )


def _flat(recorded: Recorded, origin: str, name: str) -> Any:
    import rerun.blueprint as rrb

    if not recorded.has(origin):
        return None
    bounds = None
    size = recorded.images.get(origin) or recorded.images.get(f"{origin}/image")
    if size is not None:
        width, height = size
        bounds = rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height))
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds, background=(18, 20, 24))

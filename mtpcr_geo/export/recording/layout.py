"""The layout of a recording in the rerun viewer: its blueprint, built from what was recorded."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.export.recording.focus import Look

TIMELINE = "stage"
AWAY = np.array([0.0, -0.75, 0.8])
"""From the middle of the overlap to the eye, in diameters of the overlap."""
MARGIN = 0.7
"""Half of what a picture shows, in diameters of the overlap."""
MARGIN_OF_TWO = 0.55
"""Half of what a picture of two overlaps beside each other shows, in sides of the box around both."""
_BACKGROUND = (18, 20, 24)


@dataclass(eq=False)
class Recorded:
    """What a recording holds, as far as the layout depends on it.

    Attributes:
        paths: entities that hold something.
        bounds: (2, 3) lowest and highest coordinates by entity root, metres, for the first view.
        images: (width, height) in pixels by entity root.
        looks: the overlap, by entity root; empty where there is none.

    """

    paths: set[str] = field(default_factory=set)
    bounds: dict[str, Floats] = field(default_factory=dict)
    images: dict[str, tuple[int, int]] = field(default_factory=dict)
    looks: dict[str, Look] = field(default_factory=dict)

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
            rrb.TextDocumentView(origin="stage_list", name="Stages"),
            _bars("time", "Seconds"),
            rrb.TextLogView(origin="stages", name="Log", columns=_log_columns()),
        ),
        row_shares=[2, 1],
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

    return rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["Body"])


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
    return rrb.Vertical(
        matches, _bars("hypotheses", "Candidate poses, by strength"), row_shares=[2, 1], name="Matches"
    )


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
            _bars(f"sweep/{what}", f"{title} by rotation of the source")
            for what, title in (("agreeing", "Agreeing matches"), ("matches", "Matches"))
        ]
        grids.append(rrb.Horizontal(*charts, name="Sweep"))
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
    return rrb.Horizontal(space, _bars("residuals", "Residuals"), column_shares=[2, 1], name="Tie points")


def _inputs(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    views = [
        _space(recorded, f"input/{role}", f"{role.capitalize()} as read, by height")
        for role in ("source", "target")
        if recorded.has(f"input/{role}")
    ]
    return rrb.Horizontal(*views, name="Input") if views else None


def _map(recorded: Recorded) -> Any:
    import rerun.blueprint as rrb

    return rrb.MapView(origin="map", name="Map: source orange, target blue") if recorded.has("map") else None


def _space(recorded: Recorded, origin: str, name: str, hide: tuple[str, ...] = ()) -> Any:
    """Return a 3D view that looks from the south, half from above, at the overlap, or else at everything."""
    import rerun.blueprint as rrb

    contents = ["$origin/**", *(f"- $origin/{path}/**" for path in hide)]
    look = recorded.looks.get(origin)
    bounds = recorded.bounds.get(origin)
    if look is None and bounds is not None:
        look = Look(bounds.mean(axis=0), float(np.linalg.norm(bounds[1, :2] - bounds[0, :2])) or 10.0)
    eye = None
    if look is not None:
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=look.middle + look.size * AWAY,
            look_target=look.middle,
            eye_up=(0.0, 0.0, 1.0),
        )
    return rrb.Spatial3DView(
        origin=origin,
        contents=contents,
        name=name,
        background=_BACKGROUND,
        line_grid=False,
        eye_controls=eye,
    )


def _flat(recorded: Recorded, origin: str, name: str) -> Any:
    """Return a 2D view: the overlap in its middle, or else the whole picture."""
    import rerun.blueprint as rrb

    if not recorded.has(origin):
        return None
    bounds = None
    image = next((path for path in (origin, f"{origin}/image") if path in recorded.images), None)
    if image is not None:
        width, height = recorded.images[image]
        look = recorded.looks.get(image)
        if look is None:
            bounds = rrb.VisualBounds2D(x_range=(0, width), y_range=(0, height))
        else:
            half = MARGIN * look.size if look.sides is None else MARGIN_OF_TWO * look.sides
            (left, top), (right, bottom) = look.middle - half, look.middle + half
            bounds = rrb.VisualBounds2D(x_range=(left, right), y_range=(top, bottom))
    return rrb.Spatial2DView(origin=origin, name=name, visual_bounds=bounds, background=_BACKGROUND)


def _bars(origin: str, name: str) -> Any:
    """Return a view of a table of bars."""
    import rerun.blueprint as rrb

    return rrb.TextDocumentView(origin=origin, name=name)

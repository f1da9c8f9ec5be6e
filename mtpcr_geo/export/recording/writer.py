"""The content of a recording, stage by stage, by entity path. Needs rerun, and is imported only when used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.core.version import __version__
from mtpcr_geo.core.wording import visible
from mtpcr_geo.export import descriptions, drawing
from mtpcr_geo.export.recording import bars, matching
from mtpcr_geo.export.recording.budget import Budget, thin
from mtpcr_geo.export.recording.focus import looks_of, overlap_boxes
from mtpcr_geo.export.recording.layout import TIMELINE, Recorded, layout
from mtpcr_geo.export.recording.trail import ENTITY, trail_json, what_was_made
from mtpcr_geo.export.tie_points import footprints, tie_positions

APPLICATION = "mtpcr_geo"
_ROLE_RGB = {"source": drawing.SOURCE_RGB, "target": drawing.TARGET_RGB}
_SHOWN_S = 0.05
_SMALLEST_PICTURE, _LARGEST_STEP = 64, 0.9
_LIT = 70.0
_KINDS = ("disagreeing", "agreeing", "held_out", "unjudged")


class RecordingWriter:
    """Logs a run to memory, and writes it as a rerun file in the end. All calls come from one thread.

    Args:
        path: the `.rrd` to write.
        budget: how large the file may become.
        seed: of the thinning.

    """

    def __init__(self, path: Path, budget: Budget, seed: int) -> None:
        self.budget = budget
        self.seed = seed
        self._recorded = Recorded()
        self._seen: dict[str, object] = {}
        self._stage = 0
        self._pen = matching.Pen(self._log, self._log_image, self._log_bars, budget)
        self._stages: list[tuple[str, str, float]] = []
        self._trail: list[dict[str, Any]] = []
        self._options: dict[str, dict[str, Any]] = {}
        self._properties: dict[str, Any] = {}
        self._side_texts: dict[str, str] = {}
        self._times: dict[tuple[str, str], int] = {}
        self._pair: Pair | None = None
        self._stream = rr.RecordingStream(APPLICATION, send_properties=False)
        # one clock only: the stages
        rr.set_log_time_enabled(False, recording=self._stream)
        rr.set_log_tick_enabled(False, recording=self._stream)
        # rerun's own writer waits for ever once the disk is full; this is a few megabytes
        self._path, self._memory = path, self._stream.memory_recording()
        for root in ("input/source", "input/target", "levelled", "aligned"):
            self._stream.log(root, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def begin(self, properties: Mapping[str, Any]) -> None:
        """Send what holds for the whole run as recording properties."""
        self._properties = dict(properties)
        self._stream.send_recording_name("mtpcr_geo run")
        self._send_properties("program", {"name": APPLICATION, "version": __version__})
        for name, value in properties.items():
            if isinstance(value, Mapping):
                self._send_properties(name, value)
            elif name == "inputs" and isinstance(value, list):
                for number, one in enumerate(value, start=1):
                    self._send_properties(f"input_{number}", one)
            elif name == "pipeline" and isinstance(value, list):
                self._send_properties(name, {str(one.get("tag", i)): one for i, one in enumerate(value)})
            elif isinstance(value, str):
                self._send_properties(name, {"value": value})
        self._stream.log("run", self._markdown(self._run_text()), static=True)

    def after(
        self, stage_type: str, tag: str, options: dict[str, Any], value: object, seconds: float
    ) -> None:
        """Log a finished stage: a line, its seconds, and whatever it newly made."""
        self._stream.set_time(TIMELINE, sequence=self._stage)
        self._stages.append((tag, stage_type, seconds))
        self._options[tag] = options
        made = what_was_made(value, self._pair)
        if isinstance(value, Pair):
            self._log_pair(value)
        bad = "verdict" in made and "accepted" not in made
        level = rr.TextLogLevel.WARN if bad else rr.TextLogLevel.INFO
        line = f"{tag}: {made}"  # short: lines of the log are cut off, not wrapped
        self._log("stages", rr.TextLog(visible(line), level=level))
        self._trail.append(
            {"tag": tag, "type": stage_type, "options": options, "seconds": seconds, "made": made}
        )
        self._log("seconds", rr.Scalars(seconds))
        self._log("stage_list", self._markdown(self._stage_list()))
        self._log("summary", self._markdown(self._summary()))
        self._stage += 1

    def close(self) -> None:
        """Finish the recording and write it."""
        self._path.write_bytes(self.finished())

    def finished(self) -> bytes:
        """Send the layout and return the whole recording, as it stands in a file."""
        self._stream.log("run", self._markdown(self._run_text()), static=True)
        self._log_bars("time", ("stage", "seconds"), self._time_bars())
        trail = trail_json(self._properties, self._trail, self._pair, self._drawn())
        self._stream.log(ENTITY, rr.TextDocument(trail, media_type="application/json"), static=True)
        if self._pair is not None:
            self._recorded.looks = looks_of(self._pair, self._recorded.images)
        self._stream.send_blueprint(layout(self._recorded), make_active=True, make_default=True)
        data = self._memory.drain_as_bytes()
        self._stream.disconnect()
        return bytes(data)

    def _log_pair(self, pair: Pair) -> None:
        self._pair = pair
        sides = [pair.target] if pair.source is pair.target else [pair.source, pair.target]
        if self._new("frame", pair.frame):
            self._log_frame(pair, sides)
        for side in sides:
            if self._new(f"sample {side.role}", side.sample):
                self._log_input(side)
            if self._new(f"level {side.role}", side.T_level_work):
                self._log_levelled(side)
            if side.bev is not None and self._new(f"bev {side.role}", side.bev):
                self._log_bev(side)
            if self._new(f"appearance {side.role}", side.appearance):
                matching.log_appearance(self._pen, side)
        if pair.matches is not None and self._new("hypotheses", pair.matches):
            self._log_hypotheses(pair)
            matching.log_keypoints(self._pen, pair)
            matching.log_sweep(self._pen, pair)
            matching.log_focus(self._pen, pair)
        state = (pair.matches, pair.tie_points, pair.T_target_source is None)
        if pair.matches is not None and self._new("matches", state):
            self._log_matches(pair)
        if pair.T_target_source is not None:
            moved = self._new("transform", pair.T_target_source)
            if moved:
                self._log_aligned(pair)
            if pair.tie_points is not None and (self._new("tie_points", pair.tie_points) or moved):
                self._log_ties(pair)
            if moved and pair.frame.crs is not None:
                self._log_map(pair)

    def _log_frame(self, pair: Pair, sides: list[Side]) -> None:
        names = [Path(side.cloud.name).name for side in sides]
        self._stream.send_recording_name(visible(" to ".join(names)))
        crs = pair.frame.crs
        frame = {
            "crs": crs.name if crs is not None else "local",
            "crs_wkt": crs.to_wkt() if crs is not None else "",
            "origin_m": " ".join(f"{value:.17g}" for value in pair.frame.origin),
        }
        for side in sides:
            frame[f"{side.role}_origin_m"] = " ".join(f"{value:.17g}" for value in side.link.origin)
            own = side.link.file_crs
            frame[f"{side.role}_crs"] = own.name if own is not None else "local"
        self._send_properties("frame", frame)

    def _log_input(self, side: Side) -> None:
        xyz = self._thin(side.sample, "input", side.role)
        colours = drawing.height_colours(xyz[:, 2], *drawing.height_range(xyz[:, 2]))
        # these are few, and the darkest would not be seen
        colours = (_LIT + (1.0 - _LIT / 255.0) * colours).astype(np.uint8)
        self._log_points(f"input/{side.role}", xyz, colours, root=f"input/{side.role}", radius=1.5)

    def _log_levelled(self, side: Side) -> None:
        xyz = transforms.apply(side.T_level_work, self._thin(side.sample, "levelled", side.role))
        self._log_points(f"levelled/{side.role}", xyz, _tinted(xyz, side.role), root="levelled")

    def _log_bev(self, side: Side) -> None:
        bev = side.bev
        assert bev is not None
        path = f"bev/{side.role}"
        top, cell, _ = drawing.thinned(bev, self.budget.picture_side)
        self._log_image(f"{path}/relief", drawing.shaded_relief(top, cell))
        self._log_image(f"{path}/bandpass", drawing.band_grey(top, cell))
        top = np.ascontiguousarray(drawing.thinned(bev, self.budget.height_side)[0])
        low, high = drawing.height_range(top[np.isfinite(top)])
        image = rr.DepthImage(top, meter=1.0, colormap="viridis", depth_range=(low, high))
        self._log(f"{path}/height", image)
        self._recorded.images[f"{path}/height"] = (top.shape[1], top.shape[0])

    def _log_hypotheses(self, pair: Pair) -> None:
        assert pair.matches is not None
        if not pair.matches.hypotheses:
            return
        hypotheses = pair.matches.hypotheses
        rows = descriptions.hypothesis_rows(pair)
        shown = [
            bars.Bar((*row[:3], row[4], row[3]), float(one.score if one.strength is None else one.strength))
            for one, row in zip(hypotheses, rows, strict=False)
        ]
        strong = hypotheses[0].strength is not None
        head = ("rank", "yaw", "shift", "overlap", "strength" if strong else "score")
        self._log_bars("hypotheses", head, shown)

    def _log_matches(self, pair: Pair) -> None:
        if pair.source.bev is None or pair.target.bev is None:
            return
        picture, ends, colours, kind = drawing.match_lines(pair)
        if self._new("matches picture", (pair.source.bev, pair.target.bev)):
            self._log_image("matches/image", picture)
        scale = self._recorded.images["matches/image"][0] / picture.shape[1]
        self._recorded.images["matches"] = self._recorded.images["matches/image"]
        ends = (ends + 0.5) * scale  # rerun's pixels have their centres at halves
        for number, name in enumerate(_KINDS):
            chosen = kind == number
            path = f"matches/{name}"
            if not chosen.any():
                if path in self._recorded.paths:
                    self._stream.log(path, rr.Clear(recursive=True))
                continue
            width = rr.Radius.ui_points(0.8 if number else 0.5)
            order = 20.0 + number
            lines = rr.LineStrips2D(ends[chosen], colors=colours[chosen], radii=width, draw_order=order)
            self._log(f"{path}/lines", lines)
            spots = rr.Points2D(
                ends[chosen].reshape(-1, 2),
                colors=np.repeat(colours[chosen], 2, axis=0),
                radii=rr.Radius.ui_points(2.0),
                draw_order=order + 10.0,
            )
            self._log(f"{path}/ends", spots)
            self._recorded.paths.add(path)

    def _log_aligned(self, pair: Pair) -> None:
        T = pair.T_target_source
        assert T is not None
        if self._new("aligned", pair.source.sample):
            regions = overlap_boxes(pair)
            for side in (pair.source, pair.target):
                xyz = self._thin(side.sample, "aligned", side.role, regions.get(side.role))
                self._log_points(f"aligned/{side.role}/points", xyz, _tinted(xyz, side.role))
        self._log("aligned/source", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        placed = transforms.apply(T, pair.source.sample[:: max(1, len(pair.source.sample) // 10_000)])
        self._recorded.bounds["aligned"] = _bounds(placed)

    def _log_ties(self, pair: Pair) -> None:
        target, registered = tie_positions(pair)
        tie_points = pair.tie_points
        assert registered is not None
        assert tie_points is not None
        if len(target) == 0:
            return
        residual = np.linalg.norm(registered - target, axis=1)
        colours = drawing.residual_colours(residual, *drawing.residual_limits(residual, tie_points.inlier))
        points = rr.Points3D(target, colors=colours, radii=rr.Radius.ui_points(5.0))
        self._log("aligned/tie_points", points)
        lines = rr.LineStrips3D(
            np.stack([registered, target], axis=1), colors=colours, radii=rr.Radius.ui_points(1.5)
        )
        self._log("aligned/links", lines)
        values = rr.AnyValues(
            residual_m=residual,
            score=tie_points.score,
            held_out=tie_points.held_out,
            inlier=tie_points.inlier,
        )
        self._log("aligned/tie_points", values)
        top = max(float(np.percentile(residual, 95)), 0.05)
        counts, edges = np.histogram(np.clip(residual, 0.0, top), bins=10, range=(0.0, top))
        shown = [
            bars.Bar((f"{100 * low:.0f} to {100 * high:.0f} cm", str(count)), float(count))
            for low, high, count in zip(edges[:-1], edges[1:], counts, strict=True)
        ]
        self._log_bars("residuals", ("off by", "tie points"), shown)

    def _log_map(self, pair: Pair) -> None:
        from pyproj import Transformer

        assert pair.T_target_source is not None
        to_geographic = Transformer.from_crs(pair.frame.crs, "EPSG:4326", always_xy=True)
        for role, work_ring in footprints(pair).items():
            ring = work_ring + pair.frame.origin[:2]
            longitude, latitude = to_geographic.transform(ring[:, 0], ring[:, 1])
            if not np.isfinite(longitude).all():
                continue
            line = rr.GeoLineStrings(
                lat_lon=[np.column_stack([latitude, longitude])],
                colors=[_ROLE_RGB[role]],
                radii=rr.Radius.ui_points(2.0),
            )
            self._log(f"map/{role}", line)

    def _log_points(
        self, path: str, xyz: Floats, colours: NDArray[np.uint8], root: str | None = None, radius: float = 0.9
    ) -> None:
        points = rr.Points3D(xyz.astype(np.float32), colors=colours, radii=rr.Radius.ui_points(radius))
        self._log(path, points)
        if root is not None and len(xyz):
            bounds = _bounds(xyz)
            known = self._recorded.bounds.get(root)
            if known is not None:
                bounds = np.array([np.minimum(known[0], bounds[0]), np.maximum(known[1], bounds[1])])
            self._recorded.bounds[root] = bounds

    def _log_image(self, path: str, picture: drawing.Picture) -> float:
        """Log a picture as large as the budget allows, and return by how much it was shrunk."""
        most = self.budget.picture_bytes
        small = drawing.fit(picture, self.budget.picture_side)
        data = drawing.jpeg(small)
        while len(data) > most and max(small.shape[:2]) > _SMALLEST_PICTURE:
            share = min(float(np.sqrt(most / len(data))), _LARGEST_STEP)
            small = drawing.fit(picture, int(max(small.shape[:2]) * share))
            data = drawing.jpeg(small)
        self._recorded.images[path] = (small.shape[1], small.shape[0])
        self._log(path, rr.EncodedImage(contents=data, media_type="image/jpeg"))
        return float(small.shape[1] / picture.shape[1])

    def _log_bars(self, path: str, head: Sequence[str], shown: Sequence[bars.Bar]) -> None:
        if shown:
            self._log(path, self._markdown(bars.table(head, shown)))

    def _time_bars(self) -> list[bars.Bar]:
        return [
            bars.Bar((tag, f"{seconds:.2f}"), seconds)
            for tag, _, seconds in self._stages
            if seconds >= _SHOWN_S
        ]

    def _log(self, path: str, what: Any) -> None:
        self._stream.log(path, what)
        self._recorded.paths.add(path)

    def _new(self, what: str, value: object) -> bool:
        """Return whether a value differs from the last one of that name, which is kept to compare."""
        last = self._seen.get(what)
        if isinstance(value, tuple) and isinstance(last, tuple):
            same = all(a is b for a, b in zip(value, last, strict=True))
        else:
            same = last is value
        self._seen[what] = value
        return not same

    def _thin(self, xyz: Floats, view: str, role: str, box: Floats | None = None) -> Floats:
        times = self._times.get((view, role), 0)
        self._times[view, role] = times + 1
        return thin(xyz, self.budget.points(view, times), self.seed, box)

    def _send_properties(self, name: str, values: Mapping[str, Any]) -> None:
        texts = {
            visible(str(key)).replace("-", "_"): descriptions.plain(value) for key, value in values.items()
        }
        texts = {key: visible(text) for key, text in texts.items() if text}
        if texts:
            self._stream.send_property(visible(name).replace("-", "_"), rr.AnyValues(**texts))

    @staticmethod
    def _markdown(text: str) -> Any:
        return rr.TextDocument(visible(text), media_type=rr.MediaType.MARKDOWN)

    def _drawn(self) -> str:
        if self._pair is None:
            return ""
        return self.budget.sentence(len(self._pair.source.sample), len(self._pair.target.sample))

    def _summary(self) -> str:
        pair = self._pair
        parts = []
        if pair is not None and pair.verdict is not None:
            head, meaning = pair.verdict.headline, descriptions.verdict_meaning(pair)
            parts.append(f"# {pair.verdict.name.capitalize()}\n\n{head}\n\n{meaning}")
            parts.append("\n".join(f"- {reason}" for reason in pair.verdict.reasons))
        else:
            parts.append("# Not judged yet")
        if pair is not None:
            parts.append(self._drawn())
            rows = descriptions.transform_rows(pair)
            if rows:
                parts.append("## Transform\n\n" + descriptions.markdown_list(rows))
            if pair.verdict is not None and pair.verdict.checks:
                checks = [
                    (f"{one.name}, {one.status}", f"{one.value}; wanted: {one.wanted}. *{one.meaning}*")
                    for one in pair.verdict.checks
                ]
                parts.append("## Checks\n\n" + descriptions.markdown_list(checks))
            if pair.verdict is not None and pair.verdict.metrics:
                figures = descriptions.metric_rows(pair.verdict.metrics)
                parts.append("## All figures\n\n" + descriptions.markdown_list(figures))
            for side in [pair.target] if pair.source is pair.target else [pair.source, pair.target]:
                if self._new(f"rows {side.role}", side):
                    self._side_texts[side.role] = descriptions.markdown_list(descriptions.side_rows(side))
                parts.append(f"## {side.role.capitalize()}\n\n{self._side_texts[side.role]}")
        return "\n\n".join(parts)

    def _stage_list(self) -> str:
        """List the stages so far: what each made, in lines that wrap."""
        return "\n".join(
            f"{number}. **{one['tag']}** ({one['type']}), {one['seconds']:.2f} s: {one['made']}"
            for number, one in enumerate(self._trail, start=1)
        )

    def _run_text(self) -> str:
        parts = []
        if self._options:
            rows = [(tag, descriptions.plain(options)) for tag, options in self._options.items()]
            parts.append("## Options\n\n" + descriptions.markdown_list(rows))
        for name in ("inputs", "versions"):
            value = self._properties.get(name)
            if isinstance(value, Mapping):
                rows = [(str(key), descriptions.plain(one)) for key, one in value.items()]
                parts.append(f"## {name.capitalize()}\n\n" + descriptions.markdown_list(rows))
            elif isinstance(value, list):
                parts.append(
                    f"## {name.capitalize()}\n\n" + "\n".join(f"- {descriptions.plain(v)}" for v in value)
                )
        return "\n\n".join(parts) or "nothing was recorded"


def _bounds(xyz: Floats) -> Floats:
    """Return the (2, 3) bounds of the middle 98 %, so that stray points do not shrink the first view."""
    if len(xyz) == 0:
        return np.zeros((2, 3))
    return np.asarray(np.percentile(xyz[:: max(1, len(xyz) // 20_000)], [1.0, 99.0], axis=0))


def _tinted(xyz: Floats, role: str) -> NDArray[np.uint8]:
    """Colour points by role, darker below and lighter above, so that shapes show."""
    low, high = drawing.height_range(xyz[:, 2])
    place = np.clip((xyz[:, 2:3] - low) / (high - low), 0.0, 1.0).astype(np.float32)
    colour = np.array(_ROLE_RGB[role], np.float32)
    lit = colour * (0.45 + 0.55 * place) + 70.0 * place**2
    return np.asarray(np.clip(lit, 0, 255), np.uint8)

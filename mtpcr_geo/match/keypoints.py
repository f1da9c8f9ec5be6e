"""Keypoint matchers as matchers of rasters: turn the source through orientations, choose by consistency.

No learned matcher survives more than about 45 degrees, so the source's image is turned through a sweep of
orientations and matched in each. Matches of the right one agree on a yaw and a shift, with distances in
metres; those of a wrong one do not. Cells may differ in size: both images are brought to metres first.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Hypothesis, Matches
from mtpcr_geo.match.base import Advance, Features, ImageMatcher, PixelMatches, View, margin_of
from mtpcr_geo.match.search import angle_between
from mtpcr_geo.match.turned import Frame, Turned, agreeing_by_chance, nearest_turn, posed, ties_of
from mtpcr_geo.match.turning import ZOOM, affine, magnified, reduced, shrunk
from mtpcr_geo.match.votes import (
    LEAST_STRENGTH,
    Candidates,
    VotedPose,
    agreeing_keypoints,
    candidates_of,
    strengths_of,
)
from mtpcr_geo.method.solve import ransac_upright

TRIES = 20_000
"""Pairs of matches tried for a yaw and a shift: finds a pose that 2 % of the matches support."""
AGREE_CELLS = 1.5
LEAST_AGREEING = 4
"""Matches beyond two that agree on a yaw by which the source is turned once more."""


@dataclass(frozen=True)
class Orientation:
    """What one orientation of the source came to.

    Attributes:
        turn: radians by which the source's image was turned, counter-clockwise.
        found: one-to-one matches, in pixels of the unturned images.
        T: 4x4 planar pose on which most of them agree, metres.
        agreeing: (n,) those that agree.
        runner_up: 4x4 pose on which most of the others agree.
        runner_up_count: how many they are, less two.

    """

    turn: float
    found: PixelMatches
    T: Floats
    agreeing: NDArray[np.bool_]
    runner_up: Floats
    runner_up_count: int

    @property
    def count(self) -> int:
        """Number of matches that agree; two agree always, and count nothing."""
        return max(int(self.agreeing.sum()) - 2, 0)


@dataclass(frozen=True)
class KeypointMatcher:
    """A `Matcher` that looks at images, around any `ImageMatcher`.

    Attributes:
        name: what it is called in options and reports.
        images: finds pairs of pixels.
        turns: orientations tried, evenly round the circle, where the image matcher needs it.
        magnify_to: images are magnified twice where they then stay within this edge, pixels; 0 for never.
        tolerance_m: plan distance within which matches agree, metres; 1.5 of the larger cells if None.
        sweep_keypoints: keypoints that orientations are compared by; the best is matched with all. None for
            all at once.
        sweep_to: edge that images are shrunk to, by a whole factor, for comparing orientations, pixels; 0 for
            never.
        workers: orientations described at once, where all are looked at before one is chosen.
        candidates: partners of a keypoint that vote for a pose, see `mtpcr_geo.match.votes`; 0 for poses by
            consensus of the matches alone. Only for a `FeatureMatcher` with descriptors of unit length.

    """

    name: str
    images: ImageMatcher
    turns: int = 8
    tolerance_m: float | None = None
    magnify_to: int = 0
    sweep_keypoints: int | None = None
    sweep_to: int = 0
    candidates: int = 0
    workers: int = 1
    needs_image: bool = field(default=True, init=False)
    needs_one_cell: bool = field(default=False, init=False)

    def match(
        self,
        source: View,
        target: View,
        *,
        seed: int = 0,
        yaw: float | None = None,
        advance: Advance = lambda n: None,
    ) -> Matches:
        """Match two views, see `Matcher.match`.

        The matches handed on are all of the best orientation, agreeing or not: what is wrong is for the
        solver to reject and for the verdict to count.
        """
        if source.image is None or target.image is None:
            raise ValueError(f"{self.name} matches images, and a view has none")
        longest = max(*source.image.shape, *target.image.shape)
        # by a whole factor: others beat with the pixels, and were seen to cost most matches
        zoom = ZOOM if ZOOM * longest <= self.magnify_to else 1.0
        prepared = self.images.prepare(magnified(target.image, zoom), target.empty)
        tolerance = self.tolerance_m or AGREE_CELLS * max(source.grid.cell, target.grid.cell)
        image = magnified(source.image, zoom)
        turns = self._sweep(yaw)
        if self.candidates:
            return self._by_votes(source, target, image, prepared, turns, zoom, tolerance, advance)
        tried = self._tried(source, target, turns, zoom, tolerance, seed, advance, prepared)
        chosen = max(range(len(tried)), key=lambda k: (tried[k].count, float(tried[k].found.score.sum())))
        best = tried[chosen]
        if len(turns) > 1 and (self.sweep_keypoints is not None or self.sweep_to):
            # at full size, turned by what the sweep found
            yaw = transforms.yaw_of(best.T[:3, :3])
            known = best.count >= LEAST_AGREEING and angle_between(yaw, best.turn) < np.pi / len(turns)
            turn = yaw if known else best.turn
            found = Turned.of(image, source.empty, turn, self.images).match(self.images, prepared, zoom)
            whole = _judge(turn, found, source.grid, target.grid, tolerance, seed)
            best = whole if whole.count >= best.count else best
            # strengths are compared by what all orientations were matched by
            tried[chosen] = replace(tried[chosen], T=best.T)
        if not len(best.found):
            seen = max(len(o.found.source_keypoints) for o in tried), len(best.found.target_keypoints)
            raise RegistrationError(self._nothing(seen, source.image.size))
        hypotheses = _hypotheses(tried)
        # two matches agree on any pose, so that one more counts as the least of a next pose
        margin = margin_of([one.score for one in hypotheses], floor=1.0)
        report: dict[str, Any] = {
            "method": self.name,
            "cell_m": [source.grid.cell, target.grid.cell],
            "zoom": zoom,
            "turns_deg": [round(float(np.degrees(o.turn)), 1) for o in tried],
            "turn_matches": [len(o.found) for o in tried],
            "turn_agreeing": [int(o.agreeing.sum()) for o in tried],
            "turn_deg": float(np.degrees(best.turn)),
            "agreeing": int(best.agreeing.sum()),
            "margin": margin,
            "tolerance_m": tolerance,
            "keypoints": [len(best.found.source_keypoints), len(best.found.target_keypoints)],
        }
        return Matches(
            best.found.source_px,
            best.found.target_px,
            best.found.score,
            hypotheses,
            margin=margin,
            report=report,
            source_keypoints=best.found.source_keypoints,
            target_keypoints=best.found.target_keypoints,
        )

    def _tried(
        self,
        source: View,
        target: View,
        turns: list[float],
        zoom: float,
        tolerance: float,
        seed: int,
        advance: Advance,
        prepared: Any,
    ) -> list[Orientation]:
        """Try all orientations; where there are several, by few keypoints and on small images if so set."""
        assert source.image is not None
        assert target.image is not None
        several = len(turns) > 1
        few = self.sweep_keypoints if several else None
        longest = zoom * max(*source.image.shape, *target.image.shape)
        by = -(-int(longest) // self.sweep_to) if several and self.sweep_to else 1
        image = reduced(magnified(source.image, zoom), by, source.empty)
        if by > 1:
            small = reduced(magnified(target.image, zoom), by, target.empty)
            prepared = self.images.prepare(small, target.empty)
        tried = []
        for turn in turns:
            one = Turned.of(image, source.empty, turn, self.images)
            found = one.match(self.images, prepared, zoom / by, few)
            # pixels of shrunk images are as much larger
            tried.append(_judge(turn, found, source.grid, target.grid, tolerance * max(by / zoom, 1.0), seed))
            advance(1)
        return tried

    def _by_votes(
        self,
        source: View,
        target: View,
        image: Grey,
        prepared: Any,
        turns: list[float],
        zoom: float,
        tolerance: float,
        advance: Advance,
    ) -> Matches:
        """Find a pose by the candidates of all orientations.

        The matches handed on are those of `ties_of`. The margin is over the next distinct pose and over the
        best of the mirrored source, which looks alike and has no right pose.
        """
        target_px = shrunk(prepared[0].px, zoom)
        frame = Frame(source.grid, target.grid, zoom, tolerance)
        turned = self._turned(image, source.empty, turns, advance)
        orientations = [
            self._candidates_of(one, prepared[0], zoom, turn, source.grid)
            for turn, one in zip(turns, turned, strict=True)
        ]
        voted = posed(turns, turned, orientations, prepared[0], frame)
        keypoints = max(len(one.source) for one in orientations), len(target_px)
        if not voted or not len(voted[0].found):
            raise RegistrationError(self._nothing(keypoints, image.size))
        flipped = np.ascontiguousarray(image[:, ::-1])
        others = self._turned(flipped, source.empty, turns, advance)
        mirrored = posed(
            turns,
            others,
            [
                self._candidates_of(one, prepared[0], zoom, turn, source.grid)
                for turn, one in zip(turns, others, strict=True)
            ],
            prepared[0],
            frame,
        )
        best = voted[0]
        nearest = nearest_turn(turns, best.T)
        own = turned[nearest].match(self.images, prepared, zoom)
        found = ties_of(best, own, turned[nearest], prepared[0], frame)
        chance = None
        if mirrored:
            opposite = others[nearest_turn(turns, mirrored[0].T)]
            chance = agreeing_by_chance(mirrored[0], opposite, prepared[0], frame)
        strengths, null = strengths_of(voted), strengths_of(mirrored)
        hypotheses = tuple(_hypothesis(one, value) for one, value in zip(voted, strengths, strict=True))
        rivals = [one.as_rival for one in (*voted[1:], *mirrored)]
        margin = margin_of([strengths[0], max(rivals, default=LEAST_STRENGTH)])
        report: dict[str, Any] = {
            "method": self.name,
            "cell_m": [source.grid.cell, target.grid.cell],
            "zoom": zoom,
            "turns_deg": [round(float(np.degrees(turn)), 1) for turn in turns],
            "turn_matches": [one.partner.size for one in orientations],
            "turn_agreeing": [
                agreeing_keypoints(one, best.T, target.grid.to_metres(target_px), tolerance)
                for one in orientations
            ],
            "strengths": strengths,
            "mirrored_strengths": null,
            "turn_deg": float(np.degrees(turns[nearest])),
            "agreeing": len(best.found),
            "margin": margin,
            "tolerance_m": tolerance,
            "agreeing_by_chance": chance,
            "keypoints": list(keypoints),
        }
        return Matches(
            found.source_px,
            found.target_px,
            found.score,
            hypotheses,
            margin=margin,
            by_chance=None if chance is None else (chance, tolerance),
            report=report,
            source_keypoints=found.source_keypoints,
            target_keypoints=found.target_keypoints,
        )

    def _turned(self, image: Grey, empty: int, turns: list[float], advance: Advance) -> list[Turned]:
        """Turn an image and prepare it in every orientation, several at once."""
        done = []
        with ThreadPoolExecutor(self.workers) as pool:
            for one in pool.map(lambda turn: Turned.of(image, empty, turn, self.images), turns):
                done.append(one)
                advance(1)
        return done

    def _candidates_of(
        self, turned: Turned, target: Features, zoom: float, turn: float, grid: Grid
    ) -> Candidates:
        features = cast(Features, turned.prepared[0])
        px = shrunk(affine(turned.back, features.px), zoom)
        return candidates_of(turn, features, px, target, grid, self.candidates)

    def _nothing(self, keypoints: tuple[int, int], pixels: int) -> str:
        return (
            f"{self.name} finds no match between the images ({keypoints[0]} keypoints in the source's, "
            f"{keypoints[1]} in the target's, of {pixels:,} pixels in the source's); they may be blank, too "
            "small, or of different places: try another cell (option cell), or the matcher correlation"
        )

    def _sweep(self, yaw: float | None) -> list[float]:
        if self.images.any_yaw:
            return [0.0]
        if yaw is not None:
            return [yaw]
        return [2 * np.pi * k / self.turns for k in range(self.turns)]


def _judge(
    turn: float, found: PixelMatches, source: Grid, target: Grid, tolerance: float, seed: int
) -> Orientation:
    s, t = source.to_metres(found.source_px), target.to_metres(found.target_px)
    T, agreeing = ransac_upright(s, t, tolerance, seed, TRIES)
    left = ~agreeing
    runner_up, also = ransac_upright(s[left], t[left], tolerance, seed, TRIES)
    return Orientation(turn, found, T, agreeing, runner_up, max(int(also.sum()) - 2, 0))


def _hypothesis(voted: VotedPose, strength: float) -> Hypothesis:
    T = voted.T
    return Hypothesis(
        transforms.yaw_of(T[:3, :3]), (float(T[0, 3]), float(T[1, 3])), strength, strength=strength
    )


def _hypotheses(tried: list[Orientation]) -> tuple[Hypothesis, ...]:
    """Return all poses found, those with most agreeing matches first; alike ones once."""
    poses = [(one.count, one.T) for one in tried] + [(one.runner_up_count, one.runner_up) for one in tried]
    kept: list[Hypothesis] = []
    for count, T in sorted(poses, key=lambda pose: -pose[0]):
        yaw = transforms.yaw_of(T[:3, :3])
        shift = (float(T[0, 3]), float(T[1, 3]))
        alike = any(
            angle_between(yaw, other.yaw) < np.radians(5.0)
            and np.hypot(shift[0] - other.shift[0], shift[1] - other.shift[1]) < 12.0
            for other in kept
        )
        if count and not alike:
            kept.append(Hypothesis(yaw, shift, float(count), strength=float(count)))
    return tuple(kept)

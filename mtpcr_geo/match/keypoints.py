"""Keypoint matchers as matchers of rasters: turn the source through orientations, choose by consistency.

No learned matcher survives more than about 45 degrees, so the source's image is turned through a sweep of
orientations and matched in each. Matches of the right one agree on a yaw and a shift, with distances in
metres; those of a wrong one do not. Cells may differ in size: both images are brought to metres first.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Hypothesis, Matches
from mtpcr_geo.match.base import Advance, Features, ImageMatcher, PixelMatches, View, margin_of, one_to_one
from mtpcr_geo.match.guided import agreeing_share, places_about, reach_m, within_reach
from mtpcr_geo.match.likelihood import Places, TurnedPlaces, poses_by_likelihood
from mtpcr_geo.match.search import angle_between
from mtpcr_geo.match.turning import NOT_TURNED, ZOOM, affine, magnified, places_on_ground, shrunk, turn_image
from mtpcr_geo.match.votes import (
    EXAMINED,
    KEPT,
    LEAST_STRENGTH,
    Candidates,
    VotedPose,
    agreeing_keypoints,
    candidates_of,
    poses_by_votes,
    strengths_of,
    votes_for,
)
from mtpcr_geo.method.solve import ransac_upright

TRIES = 20_000
"""Pairs of matches tried for a yaw and a shift: finds a pose that 2 % of the matches support."""
AGREE_CELLS = 1.5


@dataclass(frozen=True)
class Orientation:
    """What one orientation of the source came to.

    Attributes:
        turn: radians by which the source's image was turned, counter-clockwise.
        found: one-to-one matches, in pixels of the unturned images.
        T: 4x4 planar pose on which most of them agree, metres.
        agreeing: (n,) those that agree.
        rival: 4x4 pose on which most of the others agree.
        rival_count: how many they are, less two.

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
        candidates: partners of a keypoint that vote for a pose, see `mtpcr_geo.match.votes`; 0 for poses by
            consensus of the matches alone. Only for a `FeatureMatcher` with descriptors of unit length.

    """

    name: str
    images: ImageMatcher
    turns: int = 8
    tolerance_m: float | None = None
    magnify_to: int = 0
    sweep_keypoints: int | None = None
    candidates: int = 0
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
        few = self.sweep_keypoints if len(turns) > 1 else None
        tried, turned = [], []
        for turn in turns:
            one = _Turned.of(image, source.empty, turn, self.images)
            found = one.match(self.images, prepared, zoom, few)
            tried.append(_judge(turn, found, source.grid, target.grid, tolerance, seed))
            turned.append(one)
            advance(1)
        chosen = max(range(len(tried)), key=lambda k: (tried[k].count, float(tried[k].found.score.sum())))
        best = tried[chosen]
        if few is not None:
            found = turned[chosen].match(self.images, prepared, zoom)
            best = _judge(best.turn, found, source.grid, target.grid, tolerance, seed)
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

        The matches handed on are those of `_ties`. The margin is over the next distinct pose and over the
        best of the mirrored source, which looks alike and has no right pose.
        """
        target_px = shrunk(prepared[0].px, zoom)
        frame = _Frame(source.grid, target.grid, zoom, tolerance)
        orientations, turned = [], []
        for turn in turns:
            one = _Turned.of(image, source.empty, turn, self.images)
            orientations.append(self._candidates_of(one, prepared[0], zoom, turn, source.grid))
            turned.append(one)
            advance(1)
        voted = _posed(turns, turned, orientations, prepared[0], frame)
        keypoints = max(len(one.source) for one in orientations), len(target_px)
        if not voted or not len(voted[0].found):
            raise RegistrationError(self._nothing(keypoints, image.size))
        flipped = np.ascontiguousarray(image[:, ::-1])
        others = [_Turned.of(flipped, source.empty, turn, self.images) for turn in turns]
        mirrored = _posed(
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
        nearest = _nearest_turn(turns, best.T)
        own = turned[nearest].match(self.images, prepared, zoom)
        found = _ties(best, own, turned[nearest], prepared[0], frame)
        chance = None
        if mirrored:
            opposite = others[_nearest_turn(turns, mirrored[0].T)]
            chance = _chance(mirrored[0], opposite, prepared[0], frame)
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

    def _candidates_of(
        self, turned: _Turned, target: Features, zoom: float, turn: float, grid: Grid
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


@dataclass(frozen=True)
class _Turned:
    """The source's image in one orientation, prepared, and the affine map back to the image itself."""

    prepared: Any
    back: Floats

    @classmethod
    def of(cls, image: Grey, empty: int, turn: float, images: ImageMatcher) -> _Turned:
        turned, back = turn_image(image, turn, empty)
        return cls(images.prepare(turned, empty), back)

    def match(self, images: ImageMatcher, target: Any, zoom: float, most: int | None = None) -> PixelMatches:
        """Match to a prepared target, in pixels of the images before magnifying and turning."""
        found = images.match(self.prepared, target, most)
        return one_to_one(
            PixelMatches(
                shrunk(affine(self.back, found.source_px), zoom),
                shrunk(found.target_px, zoom),
                np.clip(found.score, 0.0, 1.0),
                shrunk(affine(self.back, found.source_keypoints), zoom),
                shrunk(found.target_keypoints, zoom),
            )
        )


@dataclass(frozen=True)
class _Frame:
    """What the pixels of two magnified images mean: the rasters' grids, the magnification, the tolerance."""

    source: Grid
    target: Grid
    zoom: float
    tolerance: float


def _posed(
    turns: list[float],
    turned: list[_Turned],
    orientations: list[Candidates],
    target: Features,
    frame: _Frame,
) -> list[VotedPose]:
    """Find poses by the descriptors of all places if the network gives these, else by keypoints' votes."""
    target_px = shrunk(target.px, frame.zoom)
    if target.places is None:
        return poses_by_votes(orientations, target_px, frame.target, frame.tolerance)
    places = [_places_of(one, target, frame) for one in turned]
    seen = [TurnedPlaces(turn, one) for turn, (one, _) in zip(turns, places, strict=True)]
    whole = places[0][1]
    found = poses_by_likelihood(seen, whole, most=EXAMINED, yaw=turns[0] if len(turns) == 1 else None)
    agreeing = votes_for([one.T for one in found], orientations, target_px, frame.target, frame.tolerance)
    weighed = [replace(one, likelihood=pose.strength) for one, pose in zip(agreeing, found, strict=True)]
    return sorted(weighed, key=lambda one: -one.strength)[:KEPT]


def _nearest_turn(turns: list[float], T: Floats) -> int:
    yaw = transforms.yaw_of(T[:3, :3])
    return min(range(len(turns)), key=lambda k: angle_between(turns[k], yaw))


def _ties(
    best: VotedPose, own: PixelMatches, turned: _Turned, target: Features, frame: _Frame
) -> PixelMatches:
    """Return what is matched about a pose, agreeing or not; about no more than its keypoints without a map.

    Where the network describes all places, each is sought near its place under the pose, and what the image
    matcher found farther off is left out. Else nothing tells where to seek: the keypoints that agree are
    returned, and all of the image matcher's.
    """
    if target.places is None:
        return one_to_one(
            PixelMatches(
                np.concatenate([best.found.source_px, own.source_px]),
                np.concatenate([best.found.target_px, own.target_px]),
                # what agrees with the pose goes before what does not
                np.concatenate([0.5 + 0.5 * best.found.score, 0.5 * own.score]),
                own.source_keypoints,
                own.target_keypoints,
            )
        )
    source, whole = _places_of(turned, target, frame)
    pairs = places_about(source, whole, best.T)
    s, t = frame.source.to_metres(own.source_px), frame.target.to_metres(own.target_px)
    own = own.take(within_reach(s, t, best.T, reach_m(whole)))
    return one_to_one(
        PixelMatches(
            np.concatenate([own.source_px, frame.source.to_pixel(source.at[pairs.index])]),
            np.concatenate([own.target_px, frame.target.to_pixel(pairs.at)]),
            np.concatenate([own.score, pairs.sure]),
            own.source_keypoints,
            own.target_keypoints,
        )
    )


def _places_of(turned: _Turned, target: Features, frame: _Frame) -> tuple[Places, Places]:
    """Return the places of the source in one orientation, and those of the target."""
    seen = cast(Features, turned.prepared[0]).places
    assert seen is not None  # the target's features have them, and come of the same graph
    assert target.places is not None
    return (
        places_on_ground(seen, turned.back, frame.zoom, frame.source),
        places_on_ground(target.places, NOT_TURNED, frame.zoom, frame.target),
    )


def _chance(mirrored: VotedPose, turned: _Turned, target: Features, frame: _Frame) -> float | None:
    """Return the share of places that agree with the mirrored source's best pose, which cannot be right."""
    if target.places is None:
        return None
    source, whole = _places_of(turned, target, frame)
    return agreeing_share(places_about(source, whole, mirrored.T), frame.tolerance)


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

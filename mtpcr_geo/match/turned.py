"""One orientation of the source: its image turned, prepared and matched, and poses by all orientations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Grey
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.match.base import Features, ImageMatcher, PixelMatches, one_to_one
from mtpcr_geo.match.guided import agreeing_share, places_about, reach_m, within_reach
from mtpcr_geo.match.likelihood import Places, TurnedPlaces, poses_by_likelihood
from mtpcr_geo.match.search import angle_between
from mtpcr_geo.match.turning import NOT_TURNED, affine, places_on_ground, shrunk, turn_image
from mtpcr_geo.match.votes import EXAMINED, KEPT, Candidates, VotedPose, poses_by_votes, votes_for


@dataclass(frozen=True)
class Turned:
    """The source's image in one orientation, prepared, and the affine map back to the image itself."""

    prepared: Any
    back: Floats

    @classmethod
    def of(cls, image: Grey, empty: int, turn: float, images: ImageMatcher) -> Turned:
        """Turn an image counter-clockwise by so many radians, and prepare it.

        Args:
            image: (h, w) uint8.
            empty: grey value of what lies outside.
            turn: radians.
            images: what prepares it.

        """
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
class Frame:
    """What the pixels of two magnified images mean: the rasters' grids, the magnification, the tolerance."""

    source: Grid
    target: Grid
    zoom: float
    tolerance: float


def posed(
    turns: list[float],
    turned: list[Turned],
    orientations: list[Candidates],
    target: Features,
    frame: Frame,
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


def nearest_turn(turns: list[float], T: Floats) -> int:
    """Return the index of the orientation, radians, that is nearest to the yaw of a 4x4 pose."""
    yaw = transforms.yaw_of(T[:3, :3])
    return min(range(len(turns)), key=lambda k: angle_between(turns[k], yaw))


def ties_of(
    best: VotedPose, own: PixelMatches, turned: Turned, target: Features, frame: Frame
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


def _places_of(turned: Turned, target: Features, frame: Frame) -> tuple[Places, Places]:
    """Return the places of the source in one orientation, and those of the target."""
    seen = cast(Features, turned.prepared[0]).places
    assert seen is not None  # the target's features have them, and come of the same graph
    assert target.places is not None
    return (
        places_on_ground(seen, turned.back, frame.zoom, frame.source),
        places_on_ground(target.places, NOT_TURNED, frame.zoom, frame.target),
    )


def agreeing_by_chance(mirrored: VotedPose, turned: Turned, target: Features, frame: Frame) -> float | None:
    """Return the share of places that agree with the mirrored source's best pose, which cannot be right."""
    if target.places is None:
        return None
    source, whole = _places_of(turned, target, frame)
    return agreeing_share(places_about(source, whole, mirrored.T), frame.tolerance)

"""How large a recording may become, and what that leaves for points and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.recorder import RECORDING_MB

_MEGABYTE = 1_000_000
# texts, matches, tie points and the layout
_FIXED_BYTES = 150_000
# a position is 12 bytes, a colour 4: both as good as incompressible
_POINT_BYTES = 16.0
# of the whole, for the points of each view of one cloud; the rest is for pictures, matches and texts
_SHARES: Mapping[str, float] = {"aligned": 0.15, "input": 0.055, "levelled": 0.045}
_HEIGHT_SHARE, _PICTURE_SHARE = 0.05, 0.025
_PICTURE_SIDE, _LEAST_SIDE, _MOST_SIDE = 1024, 128, 4096
_KEYPOINTS = 4_000
_AGAIN = 4


@dataclass(frozen=True)
class Budget:
    """The limits that follow from the size that a recording may have.

    Attributes:
        size_mb: size of the file, megabytes of 1,000,000 bytes.

    """

    size_mb: float = RECORDING_MB

    def points(self, view: str, times: int = 0) -> int:
        """Return how many points of one cloud a view may hold.

        Args:
            view: "aligned", "input" or "levelled".
            times: how often that view of the cloud was recorded before; a repetition gets a quarter.

        """
        most = self._free_bytes * _SHARES[view] / _POINT_BYTES
        return max(int(most / (_AGAIN if times else 1)), 100)

    @property
    def _free_bytes(self) -> float:
        return max(self.size_mb * _MEGABYTE - _FIXED_BYTES, 0.0)

    @property
    def picture_side(self) -> int:
        """Longer side of a picture, pixels."""
        return int(np.clip(_PICTURE_SIDE * np.sqrt(self.size_mb / RECORDING_MB), _LEAST_SIDE, _MOST_SIDE))

    @property
    def picture_bytes(self) -> int:
        """Size of an encoded picture."""
        return int(self._free_bytes * _PICTURE_SHARE)

    @property
    def height_side(self) -> int:
        """Longer side of a raster of heights, cells of 4 bytes."""
        side = np.sqrt(self._free_bytes * _HEIGHT_SHARE / 4.0)
        return int(np.clip(side, _LEAST_SIDE, _MOST_SIDE))

    @property
    def keypoints(self) -> int:
        """Keypoints an image."""
        return max(int(_KEYPOINTS * self.size_mb / RECORDING_MB), 200)

    def facts(self, points_source: int, points_target: int) -> dict[str, float | int]:
        """Return what the limits do to a run, for its record.

        Args:
            points_source: points in memory of the source, of which some are shown.
            points_target: the same of the target.

        """
        most = self.points("aligned")
        return {
            "size_mb": self.size_mb,
            "points_source": points_source,
            "points_source_shown": min(points_source, most),
            "points_target": points_target,
            "points_target_shown": min(points_target, most),
            "picture_side": self.picture_side,
        }

    def sentence(self, points_source: int, points_target: int) -> str:
        """Say what a reader of the recording sees, and what was left out."""
        known = self.facts(points_source, points_target)
        parts = [
            f"{role}: {known[f'points_{role}_shown']:,} of {known[f'points_{role}']:,} points"
            for role in ("source", "target")
        ]
        return (
            f"Drawn for a file of at most {self.size_mb:g} MB: {'; '.join(parts)}; pictures of at most "
            f"{self.picture_side} pixels a side. The registration used all points in memory."
        )


def thin(xyz: Floats, most: int, seed: int, box: Floats | None = None) -> Floats:
    """Return at most some of the points, in their order, without repeats; the same for the same seed.

    Args:
        xyz: (n, 3) points.
        most: how many are kept.
        seed: of the choice.
        box: (2, 3) region from which half of them are taken, as far as it holds so many.

    """
    if len(xyz) <= most:
        return xyz
    if box is None:
        return xyz[_some(len(xyz), most, seed)]
    inside = np.all((xyz[:, :2] >= box[0, :2]) & (xyz[:, :2] <= box[1, :2]), axis=1)
    near, far = np.flatnonzero(inside), np.flatnonzero(~inside)
    # what one part cannot fill, the other gets
    of_near = min(len(near), max(most // 2, most - len(far)))
    kept = np.concatenate([near[_some(len(near), of_near, seed)], far[_some(len(far), most - of_near, seed)]])
    return np.asarray(xyz[np.sort(kept)])


def _some(number: int, most: int, seed: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return `most` of so many places: one from each of as many equal runs, not on a beat."""
    if number <= most:
        return np.arange(number)
    starts = np.arange(most + 1) * number // most
    jitter = np.random.default_rng(seed).random(most)
    return starts[:-1] + (jitter * np.diff(starts)).astype(np.int64)

"""One pass over a whole cloud: checks, true bounds, and a sample to work on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core.arrays import ComparesArrays, Floats
from mtpcr_geo.core.cloud import CHUNK_POINTS, Cloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.transforms import bounds
from mtpcr_geo.io.no_returns import NoReturns, without
from mtpcr_geo.io.strays import beyond, stray_box, within

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress

BUDGET = 4_000_000
FEWEST_POINTS = 100
AMONG_SMALLEST = 1.25
# a double still tells an eighth of a unit apart there, and the Moon is nearer in millimetres
_LARGEST_COORDINATE = 1e15


@dataclass(frozen=True, eq=False)
class Scan(ComparesArrays):
    """Result of one pass over a cloud.

    Attributes:
        count: points in the cloud.
        dropped: of these, points classified as noise (7, 18) or flagged withheld; not in the sample.
        no_returns: of the others, points that mark beams without a return; not in the sample either.
        no_return_places: (k, 3) file coordinates where these are.
        strays: of the others, points that lie far from all; not in the sample either.
        box: (2, 3) file coordinates beyond which these lie; None where there are none.
        minimum, maximum: (3,) true bounds of all other points, in file coordinates.
        whole: (2, 3) true bounds of all points.
        sample: (n, 3) float64 file coordinates, in file order.
        complete: whether the sample is the whole cloud but for the points left out.

    """

    count: int
    dropped: int
    no_returns: int
    no_return_places: Floats
    strays: int
    box: Floats | None
    minimum: Floats
    maximum: Floats
    sample: Floats
    complete: bool
    whole: Floats

    @property
    def bounds(self) -> Floats:
        """(2, 3) true bounds of the points that are no noise, no marks of no return, and no strays."""
        return np.stack([self.minimum, self.maximum])


def scan(cloud: Cloud, *, budget: int = BUDGET, seed: int = 0, progress: Progress | None = None) -> Scan:
    """Stream a cloud once: check it, bound it, and keep a uniform random sample of it.

    The sample depends on the seed, not on how the cloud was cut into chunks. It is the whole cloud
    where that fits the budget. Memory is about 40 bytes a point of the budget, whatever the cloud's size.

    Args:
        cloud: what to read.
        budget: most points to keep.
        seed: of the random choice.
        progress: where to report the points read.

    Raises:
        InputError: if the cloud is empty, damaged, not finite, or has too few points to be registered.

    """
    if cloud.count == 0:
        raise InputError(f"{cloud.name} is empty (0 points); give a cloud with points")
    kept = _Subset(cloud.count, budget, seed)
    none = NoReturns(seed)
    count, dropped, no_returns, late = 0, 0, 0, False
    minimum, maximum = np.full(3, np.inf), np.full(3, -np.inf)
    whole = np.stack([minimum, maximum])
    task: Any = nullcontext(lambda n: None)
    if progress is not None:
        task = progress.task(f"reading {cloud.name}", cloud.count)
    with task as advance:
        for xyz, noise in cloud.noise_chunks():
            box_of_all = bounds(xyz) if len(xyz) else None
            _check_finite(cloud, xyz, box_of_all, count)
            count += len(xyz)
            if box_of_all is not None:
                whole = np.stack([np.minimum(whole[0], box_of_all[0]), np.maximum(whole[1], box_of_all[1])])
            good = xyz[~noise] if noise.any() else xyz
            dropped += len(xyz) - len(good)
            before = count - len(xyz) > 0
            late |= none.look(good) and before
            returned = without(good, none.places)
            no_returns += len(good) - len(returned)
            if len(returned):
                # hardly ever is anything left out, and then the bounds are known already
                low, high = box_of_all if returned is xyz and box_of_all else bounds(returned)
                np.minimum(minimum, low, out=minimum)
                np.maximum(maximum, high, out=maximum)
                kept.add(returned)
            advance(len(xyz))
    sample = kept.result()
    if late:  # a place that shows late may have points in what was read before
        sample = without(sample, none.places)
        minimum, maximum, no_returns = _bounds_again(cloud, none.places, None, count - dropped)
    strays, box = 0, stray_box(sample)
    if box is not None and not beyond(np.stack([minimum, maximum]), box).any():
        box = None
    if box is not None:
        number = count - dropped - no_returns
        sampled = len(sample) < number
        sample = within(sample, box)
        if sampled:
            minimum, maximum, strays = _bounds_again(cloud, none.places, box, number)
        else:
            minimum, maximum, strays = sample.min(axis=0), sample.max(axis=0), number - len(sample)
    _check_usable(cloud, count, dropped, no_returns, minimum, maximum)
    return Scan(
        count,
        dropped,
        no_returns,
        none.places,
        strays,
        box,
        minimum,
        maximum,
        sample,
        complete=len(sample) == count - dropped - no_returns - strays,
        whole=whole,
    )


def bounds_of_some(cloud: Cloud, points: int = 50_000) -> Floats | None:
    """Return the (2, 3) bounds of the first points that are no noise and mark no missing return, if any.

    Raises:
        InputError: if the file is truncated or damaged.

    """
    none = NoReturns()
    for xyz in surface_chunks(cloud, points):
        none.look(xyz)
        good = without(xyz, none.places)
        good = good[np.isfinite(good).all(axis=1)]
        if len(good):
            return np.stack([good.min(axis=0), good.max(axis=0)])
    return None


def header_remark(cloud: Cloud, whole: Floats) -> str | None:
    """Return in a sentence how the bounds that a file's header states differ from those of its points.

    Args:
        cloud: the file; of a cloud that is none nothing is said.
        whole: (2, 3) bounds of all its points.

    """
    scales = getattr(getattr(cloud, "header", None), "scales", None)
    if scales is None:
        return None
    stated = np.stack([cloud.minimum, cloud.maximum])
    tolerance = bounds_tolerance(scales, whole)
    if np.isfinite(stated).all() and (np.abs(stated - whole) <= tolerance).all():
        return None
    low, high = (", ".join(f"{value:.10g}" for value in row) for row in whole)
    return f"its header's bounds are wrong: the points lie between ({low}) and ({high}), which is used"


def bounds_tolerance(scales: Floats, whole: Floats) -> Floats:
    """Return by how much bounds in a header may differ from those of the points by rounding alone, (3,)."""
    return np.asarray(np.maximum(2.0 * np.abs(scales), 1e-9 * np.abs(whole).max(axis=0)))


def _bounds_again(cloud: Cloud, places: Floats, box: Floats | None, good: int) -> tuple[Floats, Floats, int]:
    """Return the bounds without the points on some places or beyond a box, and the number of these."""
    minimum, maximum, returned = np.full(3, np.inf), np.full(3, -np.inf), 0
    for xyz in surface_chunks(cloud, places=places, box=box):
        low, high = bounds(xyz)
        np.minimum(minimum, low, out=minimum)
        np.maximum(maximum, high, out=maximum)
        returned += len(xyz)
    return minimum, maximum, good - returned


def surface_chunks(
    cloud: Cloud, size: int = CHUNK_POINTS, places: Floats | None = None, box: Floats | None = None
) -> Iterator[Floats]:
    """Yield the whole cloud as `scan` reads it: (n, 3) float64 file coordinates, noise left out.

    Args:
        cloud: what to read.
        size: points of a chunk at most.
        places: (k, 3) file coordinates whose points are left out too: those of no returns.
        box: (2, 3) file coordinates beyond which points are left out too: strays.

    Raises:
        InputError: if the file is truncated or damaged.

    """
    for xyz, noise in cloud.noise_chunks(size):
        good = xyz[~noise] if noise.any() else xyz
        if places is not None:
            good = without(good, places)
        good = within(good, box)
        if len(good):
            yield good


class _Subset:
    """Uniform random subset of a stream: the points with the smallest random keys, in stream order.

    Of a cloud more than a fifth of which is noise it may be smaller than the budget.
    """

    def __init__(self, count: int, budget: int, seed: int) -> None:
        self.budget = budget
        self.rng = np.random.default_rng(seed) if count > budget else None
        # what has a larger key is hardly ever among the smallest in the end
        self.bound = min(1.0, AMONG_SMALLEST * budget / max(count, 1))
        room = min(count, budget + max(CHUNK_POINTS, budget // 4))
        self.points = np.empty((room, 3))
        self.keys = np.empty(room if self.rng is not None else 0)
        self.size = 0

    def add(self, xyz: Floats) -> None:
        keys: Floats | None = None
        if self.rng is not None:
            keys = self.rng.random(len(xyz))
            chosen = keys < self.bound
            xyz, keys = xyz[chosen], keys[chosen]
        start = 0
        while start < len(xyz):
            if self.size == len(self.points):
                self._thin()
            n = min(len(xyz) - start, len(self.points) - self.size)
            self.points[self.size : self.size + n] = xyz[start : start + n]
            if keys is not None:
                self.keys[self.size : self.size + n] = keys[start : start + n]
            self.size += n
            start += n

    def _thin(self) -> None:
        if self.rng is None:
            # more points than the header promised
            self.points = np.concatenate([self.points, np.empty_like(self.points)])
            return
        keys = self.keys[: self.size]
        self.bound = float(np.partition(keys, self.budget - 1)[self.budget - 1])
        chosen = keys <= self.bound
        spare = int(np.count_nonzero(chosen)) - self.budget
        if spare:
            # keys are 53 bit random numbers: equal ones are possible in theory, and the first are kept
            chosen[np.flatnonzero(keys == self.bound)[-spare:]] = False
        place = 0
        for start in range(0, self.size, CHUNK_POINTS):
            # block by block, so that no second array of all points is needed
            part = chosen[start : start + CHUNK_POINTS]
            number = int(np.count_nonzero(part))
            self.points[place : place + number] = self.points[start : start + CHUNK_POINTS][: len(part)][part]
            self.keys[place : place + number] = keys[start : start + CHUNK_POINTS][part]
            place += number
        self.size = self.budget

    def result(self) -> Floats:
        if self.rng is not None and self.size > self.budget:
            self._thin()
        # nobody else holds the array: it is cut short where it stands, without a copy beside it
        self.points.resize((self.size, 3), refcheck=False)
        return self.points


def _check_finite(cloud: Cloud, xyz: Floats, box: tuple[Floats, Floats] | None, before: int) -> None:
    # a NaN among the points is one in their bounds, and makes both comparisons false
    if box is None or (box[0].min() >= -_LARGEST_COORDINATE and box[1].max() <= _LARGEST_COORDINATE):
        return
    bad = ~np.isfinite(xyz).all(axis=1)
    what = "that are not finite"
    if not bad.any():
        bad = (np.abs(xyz) > _LARGEST_COORDINATE).any(axis=1)
        what = f"beyond {_LARGEST_COORDINATE:g}, which is no place in any unit"
    first = before + int(bad.argmax())
    raise InputError(
        f"{cloud.name} has coordinates {what} (first at point {first}); "
        "remove those points, or check the header's scales and offsets"
    )


def _check_usable(
    cloud: Cloud, count: int, dropped: int, no_returns: int, minimum: Floats, maximum: Floats
) -> None:
    good = count - dropped - no_returns
    if good == 0:
        raise InputError(
            f"every point of {cloud.name} is classified as noise or withheld; "
            "reclassify it or give another cloud"
        )
    extent = maximum - minimum
    if count == 1:
        raise InputError(f"{cloud.name} holds one point only; give a cloud of a place")
    if not extent.any():
        raise InputError(f"all {good} points of {cloud.name} are at the same place; check how it was written")
    if extent[0] == 0 or extent[1] == 0:
        raise InputError(f"{cloud.name} has no area seen from above; check its axes")
    if good < FEWEST_POINTS:
        raise InputError(
            f"{cloud.name} has {good} usable points; at least {FEWEST_POINTS} are needed, "
            "and many more for a trustworthy result"
        )

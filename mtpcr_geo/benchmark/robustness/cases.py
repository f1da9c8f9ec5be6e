"""What one run of the robustness benchmark is: a label, a recipe for two clouds, and a start.

A `Case` is small and can be sent to another process; its clouds are made where it is run. Every recipe
gives both clouds in one frame, the source where it truly lies if there is a true answer; the start then
displaces the source by a known transform, so that the truth is its inverse.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mtpcr_geo.benchmark.metrics import overlap_ratios
from mtpcr_geo.benchmark.pairs import BenchmarkPair, load_pair, read_facts
from mtpcr_geo.benchmark.robustness.degrade import WAYS
from mtpcr_geo.benchmark.robustness.places import dense_places, shared_places
from mtpcr_geo.benchmark.worker import StartRange
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Indices, Mask
from mtpcr_geo.core.errors import InputError

PLACES = 3
AIRBORNE_M = (0.09, 0.03)
"""Root mean square per axis, in plan and height, of what the residual checks of seven airborne pairs see."""
FEWEST_POINTS = 20
"""A disc with fewer points is no cloud that anybody would register."""


@dataclass(frozen=True)
class KnownTo:
    """How well a truth is known: standard deviations.

    Attributes:
        plan_m, height_m: along each axis in plan, and in height, metres.
        radius_m: of what the truth rests on, metres: its rotation is known as well as these over this.

    """

    plan_m: float = 0.0
    height_m: float = 0.0
    radius_m: float = 1.0

    @property
    def covariance(self) -> Floats:
        """(6, 6) of rotations about x, y and up, radians, and shifts along them, metres."""
        tilt, yaw = self.height_m / self.radius_m, self.plan_m / self.radius_m
        return np.diag(np.array([tilt, tilt, yaw, self.plan_m, self.plan_m, self.height_m]) ** 2)


@dataclass(frozen=True)
class CommonFrame:
    """Two clouds in one frame: metres, z up.

    Attributes:
        source: (n, 3) where it truly lies, if there is an answer.
        target: (m, 3).
        cell_m: edge of the cells in which overlap is measured, metres.
        target_crs: CRS of the target's frame but for `origin`; None for a local one.
        origin: (3,) whole metres, of this frame in the target's CRS.
        known: how well it is known that the frames are one.

    """

    source: Floats
    target: Floats
    cell_m: float = 1.0
    target_crs: str | None = None
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    known: KnownTo = KnownTo()


class Recipe(Protocol):
    """Makes the clouds of a case."""

    def make(self) -> CommonFrame:
        """Return both clouds in one frame.

        Raises:
            MtpcrError: if they cannot be read or made.

        """


@dataclass(frozen=True)
class Case:
    """One run.

    Attributes:
        suite: name of the suite.
        site: where the source lies, such as "delft_urban_ahn3" or "orchard_3"; what is to be told apart when
            a model is calibrated on some sites and shown on others.
        kind: of the site or the run, such as "forest", "whole" or "disc".
        recipe: of the clouds.
        seed: of everything drawn: of the start, of the place, and of the site where it is simulated.
        start: number of the random start.
        ranges: what the start is drawn from.
        has_truth: whether there is a right answer.
        level: option `level` of `register`.
        radius: of a disc or a plot, metres; None if the source is whole.
        place: number of the disc's place, or the target's site where that is another; "" else.
        asked_overlap: share of the source that shall be shared, where the recipe takes one.
        both_ways: register source and target exchanged too.
        options: further ones of `register`, none of which the suite sets, as names and values.

    """

    suite: str
    site: str
    kind: str
    recipe: Recipe
    seed: int = 0
    start: int = 0
    ranges: StartRange = field(default_factory=StartRange)
    has_truth: bool = True
    level: str = "none"
    radius: float | None = None
    place: str = ""
    asked_overlap: float | None = None
    both_ways: bool = False
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """Unique among all cases; rows are told apart by it."""
        parts = [self.suite, self.site, self.kind, self.place]
        parts += [f"{self.radius:g}m"] if self.radius is not None else []
        parts += [f"{100 * self.asked_overlap:g}%"] if self.asked_overlap is not None else []
        parts += [
            f"seed{self.seed}",
            f"start{self.start}",
            *(f"{key}={value}" for key, value in self.options),
        ]
        return "/".join(filter(None, parts))

    @property
    def batch(self) -> tuple[str, str]:
        """What cases have in common that are best run by one process: their clouds."""
        return self.site, "" if isinstance(self.recipe, FolderClouds | DiscClouds) else repr(self.recipe)

    def clouds(self) -> CaseClouds:
        """Make the clouds, and displace the source by the start.

        Raises:
            MtpcrError: if they cannot be read or made.

        """
        made = self.recipe.make()
        if min(len(made.source), len(made.target)) < FEWEST_POINTS:
            raise InputError(
                f"{self.name}: {len(made.source)} and {len(made.target)} points are no two clouds"
            )
        T_start, drawn = self.ranges.draw(self.site, self.start, made.source.mean(axis=0))
        origin = np.array(made.origin)
        # the start is of the frame about the origin, which is the file's where the target keeps its CRS
        T_target_true = transforms.translation(origin) if self._keeps_crs(made) else np.eye(4)
        options: dict[str, Any] = {"level": self.level, "recording": False}
        if self._keeps_crs(made):
            options |= {"source_crs": "local", "target_crs": made.target_crs}
        options |= dict(self.options)
        return CaseClouds(
            source=transforms.apply(T_start, made.source),
            target=transforms.apply(T_target_true, made.target),
            T_target_source=T_target_true @ transforms.inverse(T_start) if self.has_truth else None,
            T_start=T_start,
            options=options,
            drawn=drawn,
            middle=middle_of_overlap(made),
            known=made.known,
            overlap=overlap_ratios(made.source, made.target, made.cell_m) if self.has_truth else None,
        )

    def _keeps_crs(self, made: CommonFrame) -> bool:
        """Whether the target keeps its CRS: where levelling is to know that the target is upright."""
        return self.level == "auto" and made.target_crs is not None


@dataclass(frozen=True)
class CaseClouds:
    """The clouds of a case, as they are given to `register`.

    Attributes:
        source: (n, 3) metres, in a local frame of its own.
        target: (m, 3) metres.
        T_target_source: 4x4, the truth; None if there is no right answer.
        T_start: 4x4 from the frame in which both were made to the source's.
        options: of `register`.
        drawn: the start's yaw_deg, tilt_deg and shift_m.
        middle: (3,) middle of the source's part in the overlap where it truly lies, in the frame in which
            both were made; of the whole source where nothing is shared.
        overlap: shares of the source's and the target's cells that are shared; None without a right answer.
        known: how well the truth is known.

    """

    source: Floats
    target: Floats
    T_target_source: Floats | None
    T_start: Floats
    options: dict[str, Any]
    drawn: dict[str, float]
    middle: Floats
    overlap: tuple[float, float] | None
    known: KnownTo = KnownTo()


@lru_cache(maxsize=32)
def known_to(folder: Path) -> KnownTo:
    """Return how well the truth of a real pair is known, as its ``pair.json`` says.

    That is ``ground_truth.known_to_m``, or else the shift that its ``residual_check`` sees, which itself is
    known only to a part of a cell: no airborne pair is taken for better than `AIRBORNE_M`.
    """
    facts = read_facts(folder)
    pair = _pair(folder)
    made = CommonFrame(pair.source, pair.target, pair.overlap_cell_m)
    shared = made.source[_shared(made)]
    radius = float(np.sqrt(shared[:, :2].var(axis=0).sum())) if len(shared) > 1 else 1.0
    stated = facts["ground_truth"].get("known_to_m")
    if stated is not None:
        return KnownTo(float(stated), float(stated), radius)
    seen = facts.get("residual_check", {})
    plan = float(np.hypot(seen.get("dx_m", 0.0), seen.get("dy_m", 0.0)) / np.sqrt(2.0))
    return KnownTo(max(plan, AIRBORNE_M[0]), AIRBORNE_M[1], radius)


def middle_of_overlap(made: CommonFrame) -> Floats:
    """Return the mean (3,) of the source's points in cells that the target fills too; of all if in none."""
    shared = _shared(made)
    return np.asarray((made.source[shared] if shared.any() else made.source).mean(axis=0))


def _shared(made: CommonFrame) -> Mask:
    """Mark the source's points (n,) in cells that the target fills too."""
    keys = [_cell_keys(xyz, made.cell_m) for xyz in (made.source, made.target)]
    return np.asarray(np.isin(keys[0], np.unique(keys[1])))


@dataclass(frozen=True)
class FolderClouds:
    """A pair of a folder, as it is.

    Attributes:
        folder: of the pair.

    """

    folder: Path

    def make(self) -> CommonFrame:
        """Return both clouds where they truly lie, noise left out."""
        pair = _pair(self.folder)
        origin = (float(pair.origin[0]), float(pair.origin[1]), float(pair.origin[2]))
        return CommonFrame(
            pair.source,
            pair.target,
            pair.overlap_cell_m,
            target_crs_of(read_facts(self.folder)),
            origin,
            known_to(self.folder),
        )


@dataclass(frozen=True)
class DiscClouds:
    """A disc of a pair's source against its whole target, at a place where both have points.

    Attributes:
        folder: of the pair.
        radius: metres.
        place: number of the place, 0 to 2; the same for all radii.
        seed: of the choice of places.

    """

    folder: Path
    radius: float
    place: int
    seed: int = 0

    def make(self) -> CommonFrame:
        """Return the disc and the target."""
        pair = _pair(self.folder)
        rng = np.random.default_rng([self.seed, *self.folder.name.encode()])
        centre = shared_places(pair.source, pair.target, PLACES, rng)[self.place]
        part = disc(pair.source, centre, self.radius)
        return CommonFrame(part, pair.target, pair.overlap_cell_m, known=known_to(self.folder))


@dataclass(frozen=True)
class DegradedClouds:
    """A pair whose source another instrument might have seen.

    Attributes:
        folder: of the pair.
        way: name of one of `degrade.WAYS`.
        seed: of what is drawn.

    """

    folder: Path
    way: str
    seed: int = 0

    def make(self) -> CommonFrame:
        """Return the source made worse, and the target."""
        made = FolderClouds(self.folder).make()
        rng = np.random.default_rng([self.seed, *self.folder.name.encode(), *self.way.encode()])
        return replace(made, source=WAYS[self.way](made.source, rng))


@dataclass(frozen=True)
class MirroredClouds:
    """The reflected source of a pair, or a disc of it, against its target: there is no right answer.

    Attributes:
        folder, radius, place, seed: as of `DiscClouds`; all of the source if the radius is None.

    """

    folder: Path
    radius: float | None = None
    place: int = 0
    seed: int = 0

    def make(self) -> CommonFrame:
        """Return the source reflected east to west about its middle, and the target."""
        made: CommonFrame
        if self.radius is None:
            made = FolderClouds(self.folder).make()
        else:
            made = DiscClouds(self.folder, self.radius, self.place, self.seed).make()
        middle = np.array([np.median(made.source[:, 0]), 0.0, 0.0])
        return CommonFrame((made.source - middle) * [-1.0, 1.0, 1.0] + middle, made.target, made.cell_m)


@dataclass(frozen=True)
class ElsewhereClouds:
    """A disc of a pair's source against what of the target lies elsewhere: there is no right answer.

    Attributes:
        folder, radius, place, seed: as of `DiscClouds`.

    """

    folder: Path
    radius: float
    place: int
    seed: int = 0

    def make(self) -> CommonFrame:
        """Return the disc, and the target without what lies within twice its radius."""
        made = DiscClouds(self.folder, self.radius, self.place, self.seed).make()
        centre = (made.source.min(axis=0) + made.source.max(axis=0))[:2] / 2
        away = ((made.target[:, :2] - centre) ** 2).sum(axis=1) > (2.0 * self.radius) ** 2
        return CommonFrame(made.source, made.target[away], made.cell_m)


@dataclass(frozen=True)
class UnrelatedClouds:
    """The source of one pair against the target of another: there is no right answer.

    Attributes:
        source, target: folders of two pairs.
        radius: of a disc cut from the source at a place full of points, metres; None keeps it whole.
        seed: of the choice of the place.

    """

    source: Path
    target: Path
    radius: float | None = None
    seed: int = 0

    def make(self) -> CommonFrame:
        """Return source and target, both about their middle."""
        source = _pair(self.source).source
        if self.radius is not None:
            rng = np.random.default_rng([self.seed, *self.source.name.encode(), *self.target.name.encode()])
            source = disc(source, dense_places(source, 1, rng)[0], self.radius)
        return CommonFrame(source - np.median(source, axis=0), _pair(self.target).target)


def _cell_keys(xyz: Floats, cell: float) -> Indices:
    """Return a number (n,) for the cell of each point, the same for points in one cell."""
    column, row = np.floor(xyz[:, :2].T / cell).astype(np.int64)
    return np.asarray(column * 2**31 + row, np.int64)


def disc(xyz: Floats, centre: Floats, radius: float) -> Floats:
    """Return the points of (n, 3) within `radius` metres of `centre` (2,) in plan."""
    return np.asarray(xyz[((xyz[:, :2] - centre) ** 2).sum(axis=1) < radius**2])


def target_crs_of(facts: dict[str, Any]) -> str | None:
    """Return the horizontal CRS that a pair's description names; None if the pair is local."""
    named = str(facts.get("crs", ""))
    found = re.search(r"EPSG:\d+", named)
    return None if found is None or named.startswith(("local", "none")) else found[0]


@lru_cache(maxsize=4)
def _pair(folder: Path) -> BenchmarkPair:
    return load_pair(folder)

"""Verticals as hypotheses: where the first does not convince, others are levelled by, rasterised and matched.

What a cloud shows of its vertical does not always decide: ground slopes, walls are few, axes are exchanged.
The matching of both clouds tells more, since under a wrong vertical they do not look alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.transforms import angle_deg
from mtpcr_geo.core.types import Floats, Levelling, Matches, Pair, Side
from mtpcr_geo.method.levelling import SAME_VERTICAL_DEG, verticals

MOST_TRIED = 5
"""Pairs of verticals tried at most: each costs as much as the first search."""
STEEPEST_DEG = 40.0
"""Slope of the floor up to which a cloud of known vertical is levelled by it, for the other's sake."""
CONVINCING_MARGIN, CONVINCING_NULL_RATIO = 1.5, 1.8
"""Strength over the next distinct hypothesis, and over the mirrored source's best, from which on no other
vertical is tried. Both are a little above what the verdict wants to accept."""

Attempt = Callable[[Pair], Pair]
"""Rasterise a pair whose sides have none, and match it."""


@dataclass(frozen=True)
class Tried:
    """A pair of verticals and what matching found under it.

    Attributes:
        pair: matched; as given to the attempt where nothing was found.
        failure: why nothing was found.

    """

    pair: Pair
    failure: RegistrationError | None = None

    @property
    def length_strength(self) -> float:
        """Strength of the best hypothesis in metres: the same at whatever cell the search was made."""
        matches = self.pair.matches
        if self.failure is not None or matches is None or matches.strength is None:
            return 0.0
        return matches.strength * self.pair.cell

    def audit(self, taken: bool) -> dict[str, Any]:
        """Return what was tried, for the audit."""
        matches = self.pair.matches if self.failure is None else None
        return {
            "source": self.pair.source.levelling.method,
            "target": self.pair.target.levelling.method,
            "source_tilt_deg": self.pair.source.levelling.tilt_deg,
            "target_tilt_deg": self.pair.target.levelling.tilt_deg,
            "strength": None if matches is None else matches.strength,
            "margin": None if matches is None else matches.margin,
            "taken": taken,
        }


def convinces(matches: Matches) -> bool:
    """Return whether the best hypothesis stands out so clearly that no other vertical need be tried."""
    if matches.strength is None or matches.margin is None:
        return True  # matchers without a strength cannot compare verticals
    if matches.margin < CONVINCING_MARGIN:
        return False
    return matches.null_ratio is None or matches.null_ratio >= CONVINCING_NULL_RATIO


def best_vertical(
    pair: Pair, seed: int, first: Attempt, attempt: Attempt
) -> tuple[Pair, list[dict[str, Any]]]:
    """Match a pair under its own verticals, and under others where these do not convince.

    Args:
        pair: with rasters, under the likeliest verticals.
        seed: of the levelling.
        first: matches it as it is.
        attempt: rasterises and matches it under other verticals.

    Returns:
        The pair under the verticals of the strongest matches, and what was tried, for the audit; nothing
        there where both verticals are known, or the first was convincing and both clouds had the same kind
        of evidence for theirs.

    Raises:
        RegistrationError: if there is nothing to match under any.

    """
    if pair.source.levelling.trusted and pair.target.levelling.trusted:
        return first(pair), []
    tried = [_attempted(pair, first)]
    settled = _convincing(tried[0])
    wanted = [] if settled and not _of_two_kinds(pair) else others(pair, seed)
    if settled:
        wanted = [(source, target) for source, target in wanted if source.method == target.method]
    for source, target in wanted[: MOST_TRIED - 1]:
        tried.append(_attempted(_under(pair, source, target), attempt))
        if not settled and _convincing(tried[-1]):
            break
    found = tried if settled or not _convincing(tried[-1]) else tried[-1:]
    best = max(found, key=lambda one: one.length_strength)
    if best.failure is not None:
        raise best.failure
    return best.pair, [one.audit(one is best) for one in tried] if tried[1:] else []


def others(pair: Pair, seed: int) -> list[tuple[Levelling, Levelling]]:
    """List other verticals of source and target worth trying, likeliest first.

    Both clouds are levelled by the same kind of evidence before they are by different kinds: on a slope that
    both see, two floors agree with each other though neither is level.
    """
    known = (pair.source.levelling, pair.target.levelling)
    sources, targets = (
        [side.levelling, *(one for one in _others_of(side, seed) if _may_be(side, one))]
        for side in (pair.source, pair.target)
    )
    wanted: list[tuple[Levelling, Levelling]] = []
    for source in sources:
        wanted += [(source, target) for target in targets if target.method == source.method]
        wanted.append((source, targets[0]))
    wanted += [(sources[0], target) for target in targets[1:]]
    found: list[tuple[Levelling, Levelling]] = [known]
    for one in wanted:
        if not any(_same(one, other) for other in found):
            found.append(one)
    return found[1:]


def _others_of(side: Side, seed: int) -> Sequence[Levelling]:
    known = side.levelling.others
    return verticals(side.sample, seed) if known is None else known


def _same(one: tuple[Levelling, Levelling], other: tuple[Levelling, Levelling]) -> bool:
    return all(angle_deg(_up(a), _up(b)) <= SAME_VERTICAL_DEG for a, b in zip(one, other, strict=True))


def _of_two_kinds(pair: Pair) -> bool:
    """Whether both clouds stand by different kinds of evidence, neither of which is known to be right.

    What both clouds show of their verticals then contradicts itself: on a slope that only one of them sees
    well its floor leans, and a pose some degrees off may still convince.
    """
    levellings = (pair.source.levelling, pair.target.levelling)
    return not any(one.trusted for one in levellings) and levellings[0].method != levellings[1].method


def _may_be(side: Side, other: Levelling) -> bool:
    """Whether a vertical may be tried: of a cloud that knows its own, only the floor on a slope."""
    return not side.levelling.trusted or (other.method == "floor" and other.tilt_deg < STEEPEST_DEG)


def _up(levelling: Levelling) -> Floats:
    return levelling.T_level_work[2, :3]


def _under(pair: Pair, source: Levelling, target: Levelling) -> Pair:
    sides = [
        replace(side, levelling=levelling, bev=None, appearance=None)
        for side, levelling in ((pair.source, source), (pair.target, target))
    ]
    return pair.with_(source=sides[0], target=sides[1], matches=None)


def _attempted(pair: Pair, attempt: Attempt) -> Tried:
    try:
        return Tried(attempt(pair))
    except RegistrationError as error:
        return Tried(pair, error)


def _convincing(tried: Tried) -> bool:
    matches = tried.pair.matches
    return tried.failure is None and matches is not None and convinces(matches)

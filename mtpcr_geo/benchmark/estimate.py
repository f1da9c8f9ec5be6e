"""What the benchmark asks of a method, and what a method answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from mtpcr_geo.core.arrays import Floats

Judgement = Literal["accepted", "doubtful", "refused", "unjudged"]


@dataclass(frozen=True)
class Estimate:
    """What a method answers.

    Attributes:
        T_target_source: 4x4, or None where it found nothing.
        verdict: its own; "unjudged" from a method without one.
        reason: why it refuses or doubts, or its message.
        details: numbers worth keeping with the run.
        memory_mib: peak memory where the method ran elsewhere; else it is measured around the call.
        printed: what it printed where it ran elsewhere.

    """

    T_target_source: Floats | None
    verdict: Judgement = "unjudged"
    reason: str = ""
    details: dict[str, Any] = field(default_factory=dict)
    memory_mib: float | None = None
    printed: str = ""


class Method(Protocol):
    """A method under test."""

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Find the transform.

        Args:
            source: (n, 3) float64, metres, somewhere; z about up.
            target: (m, 3) float64, metres, about the origin; z up.
            seed: of everything random.

        Raises:
            MtpcrError: where there is no answer; the run then counts as one without.

        """

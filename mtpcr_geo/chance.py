"""How improbable an agreement is by chance: the yardstick that does not depend on the scene."""

from __future__ import annotations

import numpy as np

MOST_DIGITS = 300.0


def surprise(agreeing: int, tried: int, chance: float) -> float:
    """Digits of improbability: -log10 of the probability that chance makes so many or more agree.

    Args:
        agreeing: number that agree.
        tried: number that could.
        chance: probability that one agrees by chance, 0..1.

    """
    from scipy.special import betainc

    if agreeing <= 0:
        return 0.0
    # the tail of the binomial distribution is an incomplete beta function
    tail = float(betainc(agreeing, tried - agreeing + 1, chance))
    return MOST_DIGITS if tail <= 10.0**-MOST_DIGITS else max(-float(np.log10(tail)), 0.0)


def chance_within(tolerance: float, reach: float) -> float:
    """Chance that a match anywhere in a square of half-width ``reach`` falls within a tolerance."""
    return float(min(np.pi * tolerance**2 / (2 * reach) ** 2, 0.5))

"""How improbable an agreement is by chance: the yardstick that does not depend on the scene."""

from __future__ import annotations

from math import exp, lgamma, log, log1p, pi

MAX_NEG_LOG10_P = 300.0


def neg_log10_p(agreeing: int, tried: int, chance: float) -> float:
    """Digits of improbability: -log10 of the probability that chance makes so many or more agree.

    Args:
        agreeing: number that agree.
        tried: number that could.
        chance: probability that one agrees by chance, 0..1.

    """
    if agreeing <= 0:
        return 0.0
    if chance <= 0.0:
        return MAX_NEG_LOG10_P
    # the binomial tail, summed in logarithms: its terms span hundreds of digits
    terms = [
        lgamma(tried + 1)
        - lgamma(k + 1)
        - lgamma(tried - k + 1)
        + k * log(chance)
        + (tried - k) * log1p(-chance)
        for k in range(agreeing, tried + 1)
    ]
    largest = max(terms)
    tail = largest + log(sum(exp(term - largest) for term in terms))
    return min(max(-tail / log(10.0), 0.0), MAX_NEG_LOG10_P)


def chance_within(tolerance: float, reach: float) -> float:
    """Chance that a match anywhere in a square of half-width ``reach`` falls within a tolerance."""
    return float(min(pi * tolerance**2 / (2 * reach) ** 2, 0.5))

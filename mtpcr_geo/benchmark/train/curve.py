"""The course of a training: losses of every step, written as a table, and the learning rate."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

WARM_UP, WARM_UP_STEPS = 0.05, 100
"""Share of the steps over which the learning rate rises, and how many they are at most."""
DECAY = 0.35
"""Share of the steps, at the end, over which it falls."""


class Curve:
    """Collects losses; their means over some steps are reported and kept.

    Args:
        every: steps over which is averaged.
        say: takes a line for each mean.

    """

    def __init__(self, every: int = 50, say: Callable[[str], object] = lambda line: None) -> None:
        self.every = every
        self.rows: list[dict[str, float | int | str]] = []
        self._say = say
        self._sums: dict[str, float] = {}
        self._count = 0

    def add(self, part: str, step: int, losses: dict[str, float]) -> None:
        """Take the losses of a step of a part of the training."""
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        self._count += 1
        if self._count < self.every:
            return
        means = {name: round(value / self._count, 5) for name, value in self._sums.items()}
        self.rows += [{"part": part, "step": step + 1, "name": name, "mean": v} for name, v in means.items()]
        self._say(f"{part} {step + 1}: " + ", ".join(f"{name} {value:.3f}" for name, value in means.items()))
        self._sums, self._count = {}, 0

    def write(self, path: Path) -> None:
        """Write all means as CSV: part, step, name, mean."""
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, ("part", "step", "name", "mean"))
            writer.writeheader()
            writer.writerows(self.rows)


def learning_rate(highest: float, step: int, steps: int) -> float:
    """Return the rate of a step: a linear rise, a plateau, then half a cosine down to a hundredth.

    Before it falls the rate does not depend on the number of steps, so that a training that has not come so
    far may be made longer (Haegele et al. 2024, arXiv:2405.18392).
    """
    warm = min(max(1, round(WARM_UP * steps)), WARM_UP_STEPS)
    if step < warm:
        return highest * (step + 1) / warm
    falling = max(1, round(DECAY * steps))
    gone = max(0.0, (step - (steps - falling)) / falling)
    return highest * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * gone)))

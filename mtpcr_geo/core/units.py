"""Names of units and axes that a user may declare; imports nothing, so that the command's help is quick."""

from __future__ import annotations

from typing import Literal

Unit = Literal["m", "mm", "cm", "dm", "km", "in", "ft", "us-ft", "yd"]
Axes = Literal["z-up", "y-up", "x-up", "z-down", "y-down", "x-down"]

UNITS: dict[Unit, tuple[float, str]] = {
    "m": (1.0, "metre"),
    "mm": (0.001, "millimetre"),
    "cm": (0.01, "centimetre"),
    "dm": (0.1, "decimetre"),
    "km": (1000.0, "kilometre"),
    "in": (0.0254, "inch"),
    "ft": (0.3048, "foot"),
    "us-ft": (1200 / 3937, "US survey foot"),
    "yd": (0.9144, "yard"),
}
"""Metres a unit, and its name."""

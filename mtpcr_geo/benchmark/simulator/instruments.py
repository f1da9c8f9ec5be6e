"""What scanners make of what their beams meet: ranges, returns, intensities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.benchmark.simulator.mesh import LAS_CLASS, REFLECTANCE, RELIEF_M, Material
from mtpcr_geo.benchmark.simulator.raycast import Caster
from mtpcr_geo.core.arrays import Floats, Indices, Mask

Table = dict[str, NDArray[np.generic]]
# share of the time for which one who passes by is at any one place of the way
PRESENCE = 0.12
MOST_PASSED = 20


@dataclass(frozen=True)
class Instrument:
    """How well a scanner measures.

    Attributes:
        reach_m: range at which a surface that sends back half the light is still seen, straight on.
        noise_m: standard deviation of a range.
        divergence_rad: standard deviation of a beam's direction.
        drop_out: share of returns lost for no reason.
        returns: largest number of returns of one pulse.
        closest_m: nearest range measured.

    """

    reach_m: float
    noise_m: float
    divergence_rad: float
    drop_out: float
    returns: int
    closest_m: float = 0.8


ROBOT = Instrument(85.0, 0.02, 1.2e-3, 0.06, 1)
TRIPOD = Instrument(180.0, 0.005, 2e-4, 0.02, 2)
UAV = Instrument(260.0, 0.025, 1.5e-3, 0.06, 2)
AIRBORNE = Instrument(2500.0, 0.025, 2.2e-4, 0.02, 4)


@dataclass(frozen=True)
class Beams:
    """Pulses on their way.

    Attributes:
        origin: (n, 3) metres, where the scanner truly is.
        direction: (n, 3) unit vectors.
        time: (n,) seconds.
        drift: (n, 3) metres by which the scanner misjudges its own place.

    """

    origin: Floats
    direction: Floats
    time: Floats
    drift: Floats


@dataclass(frozen=True)
class Scan:
    """What a scanner saw, in site metres.

    Attributes:
        xyz: (n, 3) float64.
        extra: further dimensions by PDAL name, each (n,).

    """

    xyz: Floats
    extra: Table

    def part(self, keep: NDArray[np.generic]) -> Scan:
        """Return the points that a boolean or index array picks."""
        return Scan(self.xyz[keep], {name: values[keep] for name, values in self.extra.items()})


def measure(caster: Caster, beams: Beams, how: Instrument, rng: np.random.Generator) -> Scan:
    """Send beams out and note what comes back.

    A beam that meets a leaf or a wire is only partly stopped: it goes on behind with a chance, up to
    the instrument's number of returns. One who walks or drives by is met only at times. Weak returns (far,
    dark, grazing) are lost; panes of glass and windows in facades mostly lose theirs. Every beam has draws
    of its own, so that one which meets something else in the last digit on another machine changes no other.

    Args:
        caster: the site.
        beams: the pulses.
        how: the instrument.
        rng: source of chance.

    """
    n = len(beams.origin)
    direction = beams.direction + rng.normal(0, how.divergence_rad, (n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    alive = np.arange(n)
    gone = np.zeros(n)
    passes, noises = rng.spawn(2)
    found: list[tuple[Indices, Floats, Floats, NDArray[np.uint8]]] = []
    tries = np.full(n, how.returns + 1)
    for _ in range(how.returns + 1 + MOST_PASSED):
        start = beams.origin[alive] + gone[alive, None] * direction[alive]
        hits = caster.cast(start, direction[alive])
        ok = np.isfinite(hits.distance)
        alive, material = alive[ok], hits.material[ok]
        gone[alive] += hits.distance[ok]
        draw = passes.random((4, n))[:, alive]
        facing = np.abs((hits.normal[ok] * direction[alive]).sum(axis=1))
        seen = _returned(gone[alive], facing, material, how, draw[0])
        seen &= ~_window(
            beams.origin[alive] + gone[alive, None] * direction[alive], hits.normal[ok], material, draw[1]
        )
        found.append((alive[seen], gone[alive[seen]].copy(), facing[seen], material[seen]))
        thin = np.isin(material, (Material.LEAF, Material.WIRE, Material.PASSING))
        tries[alive] -= material != Material.PASSING
        onward = np.where(seen, 0.45 if how.returns > 1 else 0.0, 1.0)
        on = thin & (draw[2] < onward) & (tries[alive] > 0)
        alive = alive[on]
        gone[alive] += 0.05 + 0.5 * draw[3, on]
        if not len(alive):
            break
    return _points(beams, direction, found, how, noises)


def _returned(
    distance: Floats, facing: Floats, material: NDArray[np.uint8], how: Instrument, draw: Floats
) -> Mask:
    strength = REFLECTANCE[material] / 0.5 * np.where(material == Material.LEAF, 0.8, np.sqrt(facing))
    limit = how.reach_m * np.sqrt(strength)
    chance = (1 - how.drop_out) / (1 + np.exp(np.clip((distance - limit) / (0.08 * limit), -50, 50)))
    chance *= np.where(material == Material.PASSING, PRESENCE, 1.0)
    return np.asarray((distance > how.closest_m) & (draw < chance))


def _window(xyz: Floats, normal: Floats, material: NDArray[np.uint8], draw: Floats) -> Mask:
    """Return which hits on facades fall on a pane and are lost."""
    along = normal[:, 0] * xyz[:, 1] - normal[:, 1] * xyz[:, 0]
    pane = (np.mod(along / 2.6, 1.0) < 0.42) & (np.abs(np.mod(xyz[:, 2] / 2.9, 1.0) - 0.5) < 0.24)
    return np.asarray((material == Material.FACADE) & pane & (draw < 0.7))


def _points(
    beams: Beams,
    direction: Floats,
    found: list[tuple[Indices, Floats, Floats, NDArray[np.uint8]]],
    how: Instrument,
    rng: np.random.Generator,
) -> Scan:
    pulse = np.concatenate([f[0] for f in found])
    distance = np.concatenate([f[1] for f in found])
    facing = np.concatenate([f[2] for f in found])
    material = np.concatenate([f[3] for f in found])
    order = np.lexsort((distance, pulse))
    pulse, distance, facing, material = pulse[order], distance[order], facing[order], material[order]
    first = np.r_[True, pulse[1:] != pulse[:-1]] if len(pulse) else np.zeros(0, bool)
    begin = np.flatnonzero(first)
    total = np.diff(np.r_[begin, len(pulse)])
    number = np.arange(len(pulse)) - np.repeat(begin, total) + 1
    keep = number <= how.returns
    pulse, distance, facing, material, number = (a[keep] for a in (pulse, distance, facing, material, number))
    total = np.minimum(np.repeat(total, total)[keep], how.returns)
    beam_and_return = pulse, number - 1
    spread = rng.normal(size=(len(direction), how.returns))[beam_and_return]
    noise = spread * np.hypot(how.noise_m, RELIEF_M[material])
    xyz = beams.origin[pulse] + (distance + noise)[:, None] * direction[pulse] + beams.drift[pulse]
    fade = (1.0 + distance / how.reach_m) ** 2
    light = REFLECTANCE[material] * np.where(material == Material.LEAF, 0.6, facing) / fade
    light = light * rng.gamma(20.0, 1 / 20.0, (len(direction), how.returns))[beam_and_return]
    extra: Table = {
        "Intensity": np.clip(light * 60000, 1, 65535).astype(np.uint16),
        "ReturnNumber": number.astype(np.uint8),
        "NumberOfReturns": total.astype(np.uint8),
        "Classification": LAS_CLASS[material],
        "GpsTime": beams.time[pulse],
    }
    return Scan(xyz, extra)

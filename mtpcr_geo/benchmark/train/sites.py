"""Simulated places for training: clouds of one site in one frame, from the ground and from the air."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.benchmark.simulator.kinds import KINDS, Kind
from mtpcr_geo.benchmark.simulator.pairs import simulate_pair
from mtpcr_geo.core import transforms
from mtpcr_geo.core.voxels import first_in_voxels

FIRST_SEED = 20_000
"""Seeds of the simulator from here on are for training; benchmarks and tests stay below."""
VOXEL_M = 0.15
OVERLAP = 0.6

Points = NDArray[np.float32]


@dataclass(frozen=True)
class Site:
    """Clouds of one place.

    Attributes:
        name: such as "town_20000".
        clouds: (n, 3) float32 metres, z up, all in one frame that is near its origin; by the instrument.

    """

    name: str
    clouds: dict[str, Points]


def simulate_site(kind: Kind, seed: int, *, beams: int = 500_000, extent_m: float = 170.0) -> Site:
    """Scan a site twice from the ground and twice from the air, in two epochs.

    A robot and an airborne scanner see it in one epoch in leaf, a tripod and a drone in another, without
    leaves on every second site.

    Args:
        kind: of the site.
        seed: of everything.
        beams: sent from the ground in each epoch.
        extent_m: edge of the site, metres.

    Raises:
        MissingPartError: if ``embreex`` is not installed.

    """
    rng = np.random.default_rng([seed, 41])
    origin = None
    clouds: dict[str, Points] = {}
    surveys: list[tuple[str, str, dict[str, Any]]] = [
        ("robot", "airborne", {"epochs_apart": 1}),
        ("tripod", "uav", {"epochs_apart": 2, "air_leaves": 0.3 if seed % 2 else 1.0}),
    ]
    for ground, air, more in surveys:
        pair = simulate_pair(
            kind,
            seed,
            extent_m=extent_m,
            overlap=OVERLAP,
            tilt_deg=0.0,
            ground=ground,
            air=air,
            air_density=float(rng.uniform(4.0, 14.0)),
            ground_beams=beams,
            drift_m=float(rng.uniform(0.0, 0.12)),
            **more,
        )
        low = transforms.apply(pair.T_target_source, pair.source.xyz)
        if origin is None:
            origin = np.floor(pair.target.xyz.mean(axis=0))
        for name, xyz in ((ground, low), (air, pair.target.xyz)):
            near = (xyz - origin).astype(np.float32)
            clouds[name] = near[first_in_voxels(near.astype(np.float64), VOXEL_M)]
    return Site(f"{kind}_{seed}", clouds)


def kind_of(number: int) -> Kind:
    """Return the kind of the site of that number: all kinds in turn."""
    return KINDS[number % len(KINDS)]


def site(number: int, folder: Path | None = None, **options: Any) -> Site:
    """Return the training site of that number, from the folder where it was kept before.

    Args:
        number: from 0.
        folder: where simulated sites are kept, or None.
        options: of `simulate_site`.

    """
    kind, seed = kind_of(number), FIRST_SEED + number
    path = None if folder is None else folder / f"{kind}_{seed}.npz"
    if path is not None and path.is_file():
        with np.load(path) as kept:
            return Site(f"{kind}_{seed}", {name: kept[name] for name in kept.files})
    made = simulate_site(kind, seed, **options)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".part.npz")
        np.savez(partial, **made.clouds)  # type: ignore[arg-type]
        partial.replace(path)
    return made

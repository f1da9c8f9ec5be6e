"""The options of a simulated pair, declared once for Python and for the command."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mtpcr_geo.benchmark.simulator.kinds import Kind
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.registry import first_problem

Ground = Literal["robot", "tripod"]
Air = Literal["airborne", "uav"]
Leaves = Annotated[float, Field(ge=0, le=1)]


class PairOptions(BaseModel):
    """What `simulate_pair` and ``mtpcr-geo simulate`` take."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Kind = Field("town", description="kind of site")
    seed: int = Field(0, ge=0, description="seed of the site, its scanners, their noise and the transform")
    extent_m: float = Field(400.0, ge=100, le=1500, description="edge of the square site, metres")
    overlap: float = Field(
        0.18, ge=0.01, le=0.8, description="share aimed at on both sides; the pair holds what came out"
    )
    tilt_deg: float = Field(
        5.0, ge=-180, le=180, description="tilt of the ground cloud's frame about any level axis, degrees"
    )
    ground: Ground = Field(
        "robot", description="robot: spinning lidar driven along roads; tripod: static set-ups along them"
    )
    air: Air = Field(
        "airborne", description="airborne: line scanner, two flight lines; uav: spinning lidar, 70 m up"
    )
    air_density: float = Field(6.0, ge=0.1, le=200, description="aerial pulses per square metre")
    ground_beams: int = Field(2_000_000, ge=1, description="beams sent from the ground, in all")
    voxel_m: float = Field(
        0.12,
        ge=0,
        allow_inf_nan=False,
        description="the ground cloud keeps one point per voxel of this edge, metres; 0 keeps all",
    )
    drift_m: float = Field(
        0.04,
        ge=0,
        allow_inf_nan=False,
        description="standard deviation of the robot's position error, metres",
    )
    leafiness: tuple[Leaves, Leaves] = Field(
        (1.0, 1.0),
        description="share of leaves on the trees on the ground's and on the air's day (winter: 0.25)",
    )
    epochs_apart: int = Field(
        1, ge=0, description="0: one epoch; 1 or more: plants, crops, cars and some buildings differ"
    )


def pair_options(**options: Any) -> PairOptions:
    """Read the options of a pair.

    Raises:
        OptionError: if one is unknown or out of its range.

    """
    try:
        return PairOptions.model_validate(options)
    except ValidationError as error:
        raise OptionError(f"simulated pair: {first_problem(error, PairOptions)}") from None

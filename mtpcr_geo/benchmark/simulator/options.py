"""The options of a simulated pair, declared once for Python and for the command."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mtpcr_geo.benchmark.simulator.kinds import Kind
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.options import first_problem
from mtpcr_geo.pipeline.shown import RUN, Shown

Ground = Literal["robot", "tripod"]
Air = Literal["airborne", "uav"]


class PairOptions(BaseModel):
    """What `simulate_pair` and ``mtpcr-geo simulate`` take."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Annotated[Kind, Field(description="kind of site"), Shown(RUN)] = "town"
    seed: Annotated[
        int,
        Field(ge=0, description="seed of the site, its scanners, their noise and the transform"),
        Shown(RUN),
    ] = 0
    extent_m: Annotated[
        float, Field(ge=100, le=1500, description="edge of the square site, metres"), Shown(RUN)
    ] = 400.0
    overlap: Annotated[
        float,
        Field(ge=0.01, le=0.8, description="share aimed at on both sides; pair.json holds what came out"),
        Shown(RUN),
    ] = 0.18
    tilt_deg: Annotated[
        float,
        Field(ge=-180, le=180, description="tilt of the ground cloud's frame about any level axis, degrees"),
        Shown(RUN),
    ] = 5.0
    ground: Annotated[
        Ground,
        Field(
            description="scanner on the ground: robot, a spinning lidar driven along roads, or tripod, "
            "static set-ups along them"
        ),
        Shown(RUN),
    ] = "robot"
    air: Annotated[
        Air,
        Field(
            description="scanner in the air: airborne, a line scanner on two flight lines, or uav, a "
            "spinning lidar 70 m up"
        ),
        Shown(RUN),
    ] = "airborne"
    air_density: Annotated[
        float, Field(ge=0.1, le=200, description="aerial pulses per square metre"), Shown(RUN)
    ] = 6.0
    ground_beams: Annotated[
        int, Field(ge=1, description="beams sent from the ground, in all"), Shown(RUN)
    ] = 2_000_000
    voxel_m: Annotated[
        float,
        Field(
            ge=0,
            allow_inf_nan=False,
            description="the ground cloud keeps one point per voxel of this edge, metres; 0 keeps all",
        ),
        Shown(RUN),
    ] = 0.12
    drift_m: Annotated[
        float,
        Field(
            ge=0, allow_inf_nan=False, description="standard deviation of the robot's position error, metres"
        ),
        Shown(RUN),
    ] = 0.04
    ground_leaves: Annotated[
        float,
        Field(ge=0, le=1, description="share of leaves on the trees on the ground scan's day (winter: 0.25)"),
        Shown(RUN),
    ] = 1.0
    air_leaves: Annotated[
        float,
        Field(ge=0, le=1, description="share of leaves on the trees on the aerial scan's day"),
        Shown(RUN),
    ] = 1.0
    epochs_apart: Annotated[
        int,
        Field(
            ge=0,
            description="0 for one epoch; 1 or more for plants, crops, cars and some buildings that differ",
        ),
        Shown(RUN),
    ] = 1


def pair_options(**options: Any) -> PairOptions:
    """Read the options of a pair.

    Raises:
        OptionError: if one is unknown or out of its range.

    """
    try:
        return PairOptions.model_validate(options)
    except ValidationError as error:
        raise OptionError(f"simulated pair: {first_problem(error, PairOptions)}") from None

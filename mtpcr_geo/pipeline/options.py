"""The options of a whole registration: what the command, `register` and the stage mtpcr.register take."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class MethodOptions(BaseModel):
    """Options of everything from levelling to verdict; the same words as on the command line."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    source_crs: str | None = Field(None, description="CRS of the source, instead of what its file states")
    target_crs: str | None = Field(None, description="CRS of the target, instead of what its file states")
    local: bool = Field(False, description="both clouds are local, in metres, whatever their files state")
    level: Literal["auto", "ransac", "none"] = Field(
        "auto", description="how to make the clouds upright; auto trusts georeferenced clouds"
    )
    cell: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="cell of the height rasters, metres; chosen if not given"
    )
    vertical: Literal["refuse", "assume-same", "estimate"] = Field(
        "refuse",
        description="what to do with different or unknown vertical datums: refuse, take them as the same, or "
        "estimate the offset",
    )
    out_crs: str | None = Field(None, description="CRS of the result, where it shall not be the target's")
    prior: Literal["none", "georef"] = Field(
        "none", description="georef starts from where both clouds' CRSs put them, and searches only near it"
    )
    prior_sigma: float = Field(
        5.0, gt=0, allow_inf_nan=False, description="standard deviation of the source's place, metres"
    )
    prior_yaw: float = Field(
        5.0, gt=0, le=180, allow_inf_nan=False, description="largest turn from the prior considered, degrees"
    )
    motion: Literal["rigid", "yaw", "translation"] = Field(
        "rigid", description="degrees of freedom of the result: all six, yaw and shift, or the shift alone"
    )
    profile: Literal["default", "paper"] = Field(
        "default", description="which set of steps and settings to run: ours, or MT-PCR's as published"
    )
    matcher: str | None = Field(
        None,
        description="which matcher: correlation, rootsift, orb, or a learned one (see `mtpcr-geo models`); "
        "correlation if not given, superpoint in the paper's profile",
    )
    models: Path | None = Field(
        None, description="folder of model files; the environment variable MTPCR_GEO_MODELS if not given"
    )
    res: bool = Field(True, description="paper's profile: a resolution of its own for each cloud (Eq. 1)")
    focus: bool = Field(True, description="paper's profile: match again where the overlap is small (FOCUS)")
    enhance: bool = Field(True, description="paper's profile: sharpen the images (Eq. 4)")
    seed: int = Field(0, ge=0, description="seed of everything random")


class RegisterOptions(MethodOptions):
    """Options of a registration: of the method, and of what it leaves."""

    recording: bool = Field(True, description="keep a recording of the run for the rerun viewer")
    force: bool = Field(False, description="write the registered cloud though the verdict refuses it")
    overwrite: bool = Field(False, description="replace files that are already there")


OUTPUT_NAMES = {
    "bev": Path("bev") / "#.tif",
    "tie_points": Path("ties.gpkg"),
    "transform": Path("transform.json"),
    "matrix": Path("transform.cloudcompare.txt"),
    "pdal": Path("transform.pdal.json"),
    "recording": Path("audit.rrd"),
    "registered": Path("registered.laz"),
    "report": Path("report.html"),
    "run": Path("run.json"),
}

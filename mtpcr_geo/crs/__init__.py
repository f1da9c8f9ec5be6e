"""Coordinate reference systems, units, and the metric work frame in which everything is computed."""

from mtpcr_geo.core.frames import FrameLink, OperationReport, Vertical, WorkFrame
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.crs.facts import CrsFacts, facts_of, same_place
from mtpcr_geo.crs.resolve import LOCAL, parse_crs, resolve_frames

__all__ = [
    "LOCAL",
    "CrsFacts",
    "FrameLink",
    "OperationReport",
    "TransformChain",
    "Vertical",
    "WorkFrame",
    "facts_of",
    "parse_crs",
    "resolve_frames",
    "same_place",
]

"""Coordinate reference systems, units, and the metric work frame in which everything is computed."""

from mtpcr_geo.crs.link import FrameLink, WorkFrame
from mtpcr_geo.crs.resolve import LOCAL, parse_crs, resolve_frames

__all__ = ["LOCAL", "FrameLink", "WorkFrame", "parse_crs", "resolve_frames"]

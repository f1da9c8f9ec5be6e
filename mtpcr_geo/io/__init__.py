"""Reading, writing and moving point clouds."""

from mtpcr_geo.core.cloud import ArrayCloud, Cloud, PointTable

__all__ = ["ArrayCloud", "Cloud", "PointTable"]

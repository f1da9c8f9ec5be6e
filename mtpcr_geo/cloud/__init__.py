"""Reading, writing and moving point clouds."""

from mtpcr_geo.cloud.base import ArrayCloud, Cloud, PointTable

__all__ = ["ArrayCloud", "Cloud", "PointTable"]

"""Reading, writing and moving point clouds."""

from mtpcr_geo.core.cloud import ArrayCloud, Cloud, PointTable

__all__ = ["ArrayCloud", "Cloud", "PointTable"]

from mtpcr_geo.core.imports import without

with without("requests"):  # laspy can read from a server, which nothing here does; it takes as long as laspy
    import laspy as laspy

"""PDAL's own stages in pipelines, where PDAL is installed."""

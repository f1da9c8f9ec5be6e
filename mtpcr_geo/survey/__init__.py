"""Surveys of many tiles: a mosaic of height rasters to register against, and many registrations at once.

`build_survey` makes the mosaic, `register_in_survey` finds a scan in it and registers it to the points of the
tiles there, `run_batch` registers many sources. Building and batches run on Dask where more than one process
is wanted; nothing of it is imported before.
"""

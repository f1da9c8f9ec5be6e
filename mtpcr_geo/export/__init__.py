"""What a run leaves behind: rasters, transform files, tie points, report."""

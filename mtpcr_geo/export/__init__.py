"""What a run leaves behind: rasters, transform files, ties, report."""

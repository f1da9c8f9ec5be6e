"""The report of a run, as HTML that needs no other file."""

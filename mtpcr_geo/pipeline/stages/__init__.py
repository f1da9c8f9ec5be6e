"""The stages served by this package: a few lines each around the method."""

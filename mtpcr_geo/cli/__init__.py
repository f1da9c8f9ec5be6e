"""The command `mtpcr-geo`: one module for each verb."""

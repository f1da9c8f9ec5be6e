"""Simulated sites, scanned from the ground and from the air by ray casting."""

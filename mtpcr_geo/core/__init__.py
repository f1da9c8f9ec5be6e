"""Transforms, grids, clouds, types and small tools that every other room builds on."""

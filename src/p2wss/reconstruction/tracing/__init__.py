"""Outlines derived from points, where there are no footprints."""

"""Footprints moved to where the points show the buildings, and flags where the points contradict a footprint."""

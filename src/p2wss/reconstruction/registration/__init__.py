"""Footprints moved to where the points are, and what is wrong with them."""

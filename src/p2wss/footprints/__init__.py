"""Footprints: reading, schemas of their sources, and the cleaning of whole blocks."""

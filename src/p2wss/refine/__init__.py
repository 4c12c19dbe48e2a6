"""Roofs fitted to points through the geometry kernel: analysis by synthesis, with or without a network."""

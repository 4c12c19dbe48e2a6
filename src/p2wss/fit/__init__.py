"""Parametric buildings fitted to points: analysis by synthesis, with or without a network."""

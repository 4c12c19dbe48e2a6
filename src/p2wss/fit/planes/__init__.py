"""Roofs of any shape from their planes: planes in the points, lines where they end, cells between the lines."""

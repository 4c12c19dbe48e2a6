"""Points of buildings: an index on disk, missing classes, points of neighbours, the ground, and plausibility."""

"""The angles that a roof may have at a footprint edge (paper, section 3.1), in whole degrees."""

FLAT_DEG = 0
# a gable, or a wall up to the roof
VERTICAL_DEG = 90
# slopes, both ends included
MIN_SLOPE_DEG, MAX_SLOPE_DEG = 20, 45

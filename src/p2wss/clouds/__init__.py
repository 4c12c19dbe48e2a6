"""Point clouds: reading, classes, the points of each building, and the ground under it."""

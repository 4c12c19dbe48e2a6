"""Classes of LiDAR points (LAS 1.4 R15, table 17)."""

UNCLASSIFIED_CLASS = 1
GROUND_CLASS = 2
VEGETATION_CLASS = 5
BUILDING_CLASS = 6
NOISE_CLASSES = (7, 18)  # low and high noise

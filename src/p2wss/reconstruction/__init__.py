"""Stage reconstruct: closed buildings from footprints and LiDAR (paper, section 5.4)."""

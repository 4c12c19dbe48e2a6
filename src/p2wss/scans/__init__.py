"""Stage scans: a simulated airborne LiDAR survey of one scene (paper, section 5.1)."""

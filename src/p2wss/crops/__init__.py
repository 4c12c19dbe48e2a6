"""Stage crops: the points of each building, from a simulated scan or from real LiDAR (paper, section 5.1)."""

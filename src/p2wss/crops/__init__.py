"""Stage crops: the points of each building, from a simulated scan or from real LiDAR (paper, section 5.1)."""

from p2wss.crops.real import crop_real
from p2wss.crops.simulated import crop_simulated, scan_of

__all__ = ["crop_real", "crop_simulated", "scan_of"]

"""Stage crops: the points of each building, from a simulated scan or from real LiDAR (paper, section 5.1)."""

from p2wss.crops.crop import LIDAR, SYNTHETIC, check_crs, crop_lidar, crop_scene, read_scan
from p2wss.crops.manifest import list_shards
from p2wss.crops.splits import assign_splits

__all__ = [
    "LIDAR",
    "SYNTHETIC",
    "assign_splits",
    "check_crs",
    "crop_lidar",
    "crop_scene",
    "list_shards",
    "read_scan",
]

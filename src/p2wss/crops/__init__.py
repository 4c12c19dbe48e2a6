"""Stage crops: the points of each building, from a simulated scan or from real LiDAR (paper, section 5.1)."""

from p2wss.crops.manifest import list_shards
from p2wss.crops.real import crop_real
from p2wss.crops.simulated import crop_simulated
from p2wss.crops.splits import assign_splits

__all__ = [
    "assign_splits",
    "crop_real",
    "crop_simulated",
    "list_shards",
]

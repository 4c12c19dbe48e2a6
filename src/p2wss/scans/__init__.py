"""Stage scans: a simulated airborne LiDAR survey of one scene (paper, section 5.1)."""

from p2wss.scans.scan import Scan, check_dtm_crs, simulate, write_scan

__all__ = ["Scan", "check_dtm_crs", "simulate", "write_scan"]

"""Stage scans: a simulated airborne LiDAR survey of one scene (paper, section 5.1)."""

from p2wss.scans.scan import Scan, simulate, write_scan

__all__ = ["Scan", "simulate", "write_scan"]

"""p2wss: building footprints and aerial LiDAR to clean, watertight, low-polygon LoD2 buildings."""

__version__ = "0.1.0"

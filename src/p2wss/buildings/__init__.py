"""Stage buildings: closed building meshes from the weighted straight skeleton (paper, section 3)."""

from p2wss.buildings.build import build_scene, failed_fraction

__all__ = ["build_scene", "failed_fraction"]

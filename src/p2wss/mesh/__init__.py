"""Meshes of buildings: their topology, faces, distances, and the rules that a valid solid follows."""

from p2wss.mesh.mesh import Mesh

__all__ = ["Mesh"]

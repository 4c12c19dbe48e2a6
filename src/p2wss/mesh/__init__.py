"""Meshes of buildings: their topology, faces, distances, and the rules that a valid solid follows."""

"""Meshes of fitted buildings that are not of planes, and the open ground of all."""

"""Solids as planar polygons: the faces of a mesh, and whether they follow the rules of ISO 19107."""

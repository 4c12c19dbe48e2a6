"""Stages scenes and buildings: tiles of clean footprints with heights and roof angles, and their meshes."""

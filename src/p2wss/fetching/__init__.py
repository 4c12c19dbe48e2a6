"""Stage fetch: footprints, terrain and LiDAR, from IGN's services or from files on disk.

Fetched data are normalised, so that no later stage depends on their origin.
"""

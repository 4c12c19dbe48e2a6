"""Stage fetch: footprints, terrain and LiDAR, from IGN's services or from files on disk.

What is fetched is normalised, so that no later stage depends on where the data came from.
"""

"""The files that one stage writes and others read, one module per file.

The description of a column, with its unit, is in the metadata of its field; ``p2wss inspect FILE`` prints it.
Columns ``*_xy_m`` and ``vertex_xyz_m`` are flattened (x0, y0, x1, y1, ...) and relative to (``origin_x_m``,
``origin_y_m``) in the projected CRS of the file. Heights of meshes are above ``terrain_z_m`` (buildings) or
``ground_z_m`` (reconstructions).
"""

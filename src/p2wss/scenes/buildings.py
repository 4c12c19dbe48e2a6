"""Build the closed mesh of each footprint from its eave height and roof angles (paper, section 3)."""

from typing import Any

import geopandas as gpd
import numpy as np
import shapely
import trimesh
from numpy.typing import ArrayLike

from p2wss import skeleton
from p2wss.config import Buildings
from p2wss.data import polygon_arrays
from p2wss.storage import files
from p2wss.storage.messages import InputError, reading


def build_scene(scene: gpd.GeoDataFrame, config: Buildings) -> dict[str, Any]:
    """The columns of :data:`p2wss.storage.schemas.buildings.BUILDINGS`, one row per row of ``scene``.

    scene: the columns of :data:`p2wss.storage.schemas.scene.SCENE` and a geometry. A row that the scene excludes
    keeps its status. A row that the kernel rejects gets the kernel's reason. Both have an empty mesh.
    """
    num_buildings = len(scene)
    polygons = polygon_arrays.to_polygons(scene.geometry.to_numpy())
    origin_xy_m = polygon_arrays.origins(polygons)
    status = scene["status"].to_numpy(dtype=object).copy()
    usable = np.flatnonzero(status == "ok")
    usable_polygons = polygon_arrays.take(polygons, usable)
    angle_deg = [np.asarray(scene["angle_deg"].iloc[i], dtype=float) for i in usable]
    terrain_z_m = scene["terrain_z_m"].to_numpy()
    base_z_m = scene["base_z_m"].to_numpy()

    meshes = skeleton.build(
        polygon_arrays.moved(usable_polygons, -origin_xy_m[usable]),
        np.concatenate(angle_deg) if angle_deg else np.zeros(0),
        scene["eave_height_m"].to_numpy(dtype=float)[usable],
        base_height_m=(base_z_m - terrain_z_m)[usable],
        max_roof_height_m=config.max_roof_height_m,
    )
    for row, code in zip(usable, meshes.status, strict=True):
        if code != skeleton.Status.OK:
            status[row] = skeleton.Status(code).reason

    return {
        "building_id": scene["building_id"],
        "tile": scene["tile"],
        "in_tile": scene["in_tile"],
        "status": status,
        "eave_height_m": scene["eave_height_m"].to_numpy(),  # a Series would turn NaN into null
        "terrain_z_m": terrain_z_m,
        "base_z_m": base_z_m,
        "roof_type": scene["roof_type"],
        "angle_deg": scene["angle_deg"],
        "origin_x_m": origin_xy_m[:, 0],
        "origin_y_m": origin_xy_m[:, 1],
        **polygon_arrays.to_columns(polygons, origin_xy_m),
        **mesh_columns(meshes, usable, num_buildings),
    }


# what a caller of p2wss.roof reads: what is wrong, and what to do
_WORDS = {
    skeleton.Status.EMPTY: "it is empty; give at least three corners",
    skeleton.Status.NON_FINITE: "a coordinate is NaN or infinite; give finite metres",
    skeleton.Status.TOO_MANY_EDGES: "it has too many corners; simplify it",
    skeleton.Status.NOT_SIMPLE: (
        "a ring crosses itself or another ring, or touches it to within 0.1 mm; mend it, as with shapely.make_valid, "
        "or move the courtyard off the walls"
    ),
    skeleton.Status.COURTYARD_OUTSIDE: "a courtyard is not inside the outer ring, or inside another one; remove it",
    skeleton.Status.NOT_CLEAN: "an edge is shorter than a millimetre, or a ring has no area; remove repeated corners",
    skeleton.Status.BAD_ANGLE: "an angle is none of 0, 90 and 5 to 85 degrees; change it",
    skeleton.Status.BAD_HEIGHT: "the eave is not at least a millimetre above the ground; raise it",
}


def roof_mesh(
    footprint: shapely.Polygon | shapely.MultiPolygon | ArrayLike,
    eave_height_m: float,
    angle_deg: float | ArrayLike,
) -> trimesh.Trimesh:
    """See :func:`p2wss.roof`."""
    if isinstance(footprint, shapely.MultiPolygon) and len(footprint.geoms) == 1:
        footprint = footprint.geoms[0]
    if isinstance(footprint, shapely.Geometry) and not isinstance(footprint, shapely.Polygon):
        raise InputError(
            f"the footprint is a {footprint.geom_type}, not one polygon: call p2wss.roof once for each polygon"
        )
    if not isinstance(footprint, shapely.Polygon):
        with reading("footprint", "one polygon"):
            footprint = shapely.Polygon(np.asarray(footprint, float))
    polygons = polygon_arrays.to_polygons(np.array([footprint], dtype=object))
    num_edges = len(polygons.xy_m)
    with reading("angle_deg", "one number, or one for each edge"):
        angle = np.asarray(angle_deg, float)
        angle = np.broadcast_to(angle, num_edges if angle.ndim == 0 else (len(angle),))
    if len(angle) != num_edges:
        raise InputError(f"the footprint has {num_edges} edges, but there are {len(angle)} angles")
    polygons, angle = _turned(polygons, angle)
    meshes = skeleton.build(polygons, angle, np.array([float(eave_height_m)]))
    status = skeleton.Status(int(meshes.status[0]))
    if status != skeleton.Status.OK:
        words = _WORDS.get(
            status, f"the geometry kernel failed ({status.reason}); please report this footprint"
        )
        raise InputError(f"no roof over this footprint: {words}")
    vertex_m, triangle, kind, _ = meshes.mesh(0)
    return trimesh.Trimesh(vertex_m, triangle, face_attributes={"kind": kind}, process=False)


def _turned(polygons: skeleton.Polygons, angle_deg: np.ndarray) -> tuple[skeleton.Polygons, np.ndarray]:
    """One polygon and its angles with the outer ring counter-clockwise and courtyards clockwise."""
    rings, angles = polygons.rings(0), np.split(angle_deg, polygons.ring_offset[1:-1])
    for number, ring in enumerate(rings):
        if shapely.is_ccw(shapely.LinearRing(ring)) != (number == 0):
            rings[number] = ring[::-1]
            # the edge from a corner back to the one before it comes first now
            angles[number] = np.roll(angles[number][::-1], -1)
    return skeleton.Polygons.from_rings([rings]), np.concatenate([*angles, np.zeros(0)])


def mesh_columns(meshes: skeleton.Meshes, rows: np.ndarray, num_rows: int) -> dict[str, Any]:
    """The mesh columns of a table with ``num_rows`` rows.

    Mesh i is in row ``rows[i]`` (ascending); the other rows have empty lists.
    """

    def ragged_column(values: np.ndarray, offset: np.ndarray, values_per_item: int) -> Any:
        lengths = np.zeros(num_rows, np.int64)
        lengths[rows] = np.diff(offset) * values_per_item
        return files.ragged(values.ravel(), np.concatenate([[0], np.cumsum(lengths)]))

    return {
        "vertex_xyz_m": ragged_column(meshes.vertex_m, meshes.vertex_offset, 3),
        "triangle": ragged_column(meshes.triangle, meshes.triangle_offset, 3),
        "triangle_kind": ragged_column(meshes.kind, meshes.triangle_offset, 1),
        "triangle_edge": ragged_column(meshes.edge, meshes.triangle_offset, 1),
    }

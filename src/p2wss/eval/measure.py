"""Chamfer distance, number of triangles and errors of every reconstruction (paper, section 5.3), and errors of its
height, angles and footprint against the labels (Table 1)."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from p2wss import skeleton
from p2wss.config import Config, Eval
from p2wss.data.building import Reconstruction
from p2wss.data.seeds import generator
from p2wss.eval.cases import Case, Key
from p2wss.eval.methods import MASKED
from p2wss.eval.metrics import (
    chamfer_distance_m,
    false_and_missing_share,
    height_rmse_m,
    mesh_facts,
    out_of_plane_m,
)
from p2wss.mesh import Mesh
from p2wss.mesh.surface import distance_to_mesh, sample_surface
from p2wss.skeleton.queries import roof_points
from p2wss.skeleton.types import FaceKind, Polygons
from p2wss.storage.schemas.measures import MEASURES

# least number of points on a roof that counts as seen, and over the sloped face of an edge that does; with fewer on the
# building, distances to the roof mean nothing
MIN_SEEN_POINTS = 10
PLANAR_M = 0.01
# points nearer to the edges of the footprint may be on a wall, where a height above the roof means nothing
INNER_M = 0.5
_ROOF = (FaceKind.ROOF, FaceKind.FLAT)
SEVERAL_HEIGHTS = "several heights"
# slopes whose directions differ by at most this angle make a shed
_SHED_COSINE = np.cos(np.radians(30.0))


def parameter_errors(pairs: Sequence[tuple[Case, Reconstruction]]) -> Iterator[dict[str, Any]]:
    """The columns of errors of the schema ``MEASURES`` for each case and its reconstruction.

    They are absent without labels, and where the reconstruction has no parameters; errors of angles also where the
    reconstruction has another number of edges than the label.
    """
    comparable = [
        (case, row.angle_deg, case.angle_deg)
        for case, row in pairs
        if case.angle_deg is not None
        and row.angle_deg is not None
        and len(row.angle_deg) == len(case.angle_deg)
    ]
    seen = seen_edges([case for case, _, _ in comparable], [angle_deg for _, angle_deg, _ in comparable])
    of_edges = {
        case.key: {"angle_error_deg": np.abs(angle_deg - truth_deg), "is_angle_seen": is_seen}
        for (case, angle_deg, truth_deg), is_seen in zip(comparable, seen, strict=True)
    }
    for case, row in pairs:
        is_height_seen = bool(case.building.is_on_building.sum() >= MIN_SEEN_POINTS)
        errors: dict[str, Any] = {"is_height_seen": is_height_seen, **of_edges.get(case.key, {})}
        if case.is_labelled and row.eave_height_m is not None:
            errors["height_error_m"] = abs(row.eave_height_m - target_height_m(case))
        if case.key in of_edges and row.method in MASKED:
            errors["coordinate_error_m"] = np.abs(row.rings[0] - case.building.rings[0]).ravel()
        yield errors


def seen_edges(cases: Sequence[Case], angle_deg: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Mask of the edges that the points determine, for each labelled case: bool, one value per edge over all rings.

    angle_deg: the angles by a method. An edge is seen if ten points on the building lie over its sloped face, in the
    roof of the label or of the method. A gable that the method also predicts as a gable has no face, and a wall under a
    flat roof is the same with 0 and with 90 degrees: neither counts as seen.
    """
    if not cases:
        return []
    polygons = Polygons.from_rings([list(case.building.rings) for case in cases])
    point = [case.building.point_m[case.building.is_on_building, :2] for case in cases]
    index = np.repeat(np.arange(len(cases)), [len(xy) for xy in point])
    xy = np.concatenate([*point, np.zeros((0, 2))])
    first = np.concatenate([[0], np.cumsum([len(angle) for angle in angle_deg])])
    count = np.zeros(first[-1], int)
    truth = [case.angle_deg for case in cases if case.angle_deg is not None]
    for angles in (truth, angle_deg):
        roof = roof_points(polygons, np.concatenate(list(angles)), 0.0, xy, index)
        over = roof.edge >= 0
        np.maximum(count, np.bincount(first[index[over]] + roof.edge[over], minlength=first[-1]), out=count)
    return np.split(count >= MIN_SEEN_POINTS, first[1:-1])


def target_height_m(case: Case) -> float:
    """The eave height of the label, re-based to the ground of the cloud."""
    assert case.eave_height_m is not None and case.label_terrain_z_m is not None
    return case.eave_height_m + case.label_terrain_z_m - case.building.ground_z_m


def measure(
    cases: Sequence[Case],
    reconstructions: Mapping[str, Mapping[Key, Reconstruction]],
    config: Config,
) -> Iterator[dict[str, Any]]:
    """Rows of the schema ``MEASURES``, one per case and method, methods in the order given.

    A case that is not in a method's mapping, because the method was not run on it, has no row. config: its section
    ``buildings`` states the height at which true roofs are cut off.
    """
    for by_key in reconstructions.values():
        pairs = [(case, by_key[case.key]) for case in cases if case.key in by_key]
        for (case, reconstruction), errors in zip(pairs, parameter_errors(pairs), strict=True):
            measures = measure_building(case, reconstruction, config)
            yield dict.fromkeys(MEASURES.names) | measures | errors


def measure_building(case: Case, reconstruction: Reconstruction, config: Config) -> dict[str, Any]:
    """The columns of the schema ``MEASURES`` other than errors of parameters; without a mesh, only those of the
    building.

    Random draws depend on the seed, the building and the method alone.
    """
    building = case.building
    x, y, _ = building.point_m.T
    num_inside = int(shapely.contains_xy(building.polygon, x, y).sum())
    row: dict[str, Any] = {
        "dataset": case.dataset,
        "building_id": building.building_id,
        "tile": building.tile,
        "method": reconstruction.method,
        "status": reconstruction.status,
        "num_points": len(building.point_m),
        "num_vertices": sum(map(len, building.rings)),
        "density_per_m2": num_inside / building.polygon.area,
        "roof_type": case.roof_type,
        "visible_roof_share": case.visible_roof_share,
    }
    mesh = reconstruction.mesh
    if mesh is None:
        return row
    # a flat roof instead of a mesh of the method says nothing of the building
    if reconstruction.angle_deg is not None and reconstruction.status == "ok":
        row["roof_kind"] = roof_kind(reconstruction.rings, reconstruction.angle_deg, reconstruction.num_parts)
    draw = generator(
        config.eval.seed, "eval.measure", building.tile, building.building_id, reconstruction.method
    )
    vertex_m, triangle = mesh.vertex_m, mesh.triangle
    facts = mesh_facts(vertex_m, triangle)
    # in the frame of the mesh
    point_m = building.point_m + (building.position_m - reconstruction.position_m)
    samples = sample_surface(vertex_m, triangle, config.eval.num_samples, draw)
    row |= {
        "num_parts": reconstruction.num_parts,
        "num_triangles": len(triangle),
        "watertight": facts.watertight,
        "manifold": facts.manifold,
        "planar": bool(out_of_plane_m(vertex_m, triangle, mesh.face).max() <= PLANAR_M),
        "chamfer_m": chamfer_distance_m(subset(case, point_m, config.eval), samples),
    }
    on_building = point_m[building.is_on_building]
    if len(on_building) >= MIN_SEEN_POINTS:
        roof = sample_surface(vertex_m, triangle[np.isin(mesh.kind, _ROOF)], config.eval.num_samples, draw)
        x, y, _ = building.point_m[building.is_on_building].T
        inner = on_building[shapely.contains_xy(building.polygon.buffer(-INNER_M), x, y)]
        row |= {
            "roof_chamfer_m": chamfer_distance_m(on_building, roof),
            "points_to_mesh_m": float(distance_to_mesh(on_building, vertex_m, triangle).mean()),
            "height_rmse_m": height_rmse_m(inner, mesh.corner_m),
        }
    true = true_mesh(case, config.buildings.max_roof_height_m)
    if true is not None:
        true = true.translated(-reconstruction.position_m)
        row["false_edge_share"], row["missing_edge_share"] = false_and_missing_share(mesh, true)
    return row


def true_mesh(case: Case, max_roof_height_m: float = np.inf) -> Mesh | None:
    """The building of the labels, in the CRS, its roof cut off at ``max_roof_height_m`` above the eaves; None without
    labels."""
    if case.angle_deg is None or case.eave_height_m is None or case.label_terrain_z_m is None:
        return None
    # from the ground of the label: the cloud's ground may be above the eaves
    height_m = np.array([case.eave_height_m])
    polygons = Polygons.from_rings([list(case.building.rings)])
    built = skeleton.build(polygons, case.angle_deg, height_m, max_roof_height_m=max_roof_height_m)
    return Mesh.of_kernel(built, 0).translated(np.array([*case.building.origin_xy_m, case.label_terrain_z_m]))


def subset(case: Case, point_m: np.ndarray, config: Eval) -> np.ndarray:
    """At most ``max_num_points`` of a building's points, the same for every method."""
    if len(point_m) <= config.max_num_points:
        return point_m
    draw = generator(config.seed, "eval.subset", case.building.tile, case.building.building_id)
    return point_m[np.sort(draw.choice(len(point_m), config.max_num_points, replace=False))]


def roof_kind(rings: Sequence[np.ndarray], angle_deg: np.ndarray, num_parts: int = 1) -> str:
    """The kind of a roof from the angles of its edges, for real buildings, which have no label: flat, shed, gable, hip,
    mixed, or :data:`SEVERAL_HEIGHTS`. rings: each (n, 2); angle_deg: one value per edge.

    flat: no slope at all. hip: a slope at every edge. gable: only slopes and gables (90 degrees). shed: the same, but
    all slopes face the same way. mixed: slopes and flat edges.

    >>> square = [np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])]
    >>> [roof_kind(square, np.array(a)) for a in ([40, 90, 40, 90], [40, 90, 90, 90], [40, 40, 40, 40])]
    ['gable', 'shed', 'hip']
    """
    if num_parts > 1:
        return SEVERAL_HEIGHTS
    angle = np.asarray(angle_deg, float)
    slope = (angle > 0) & (angle < 90)
    if not slope.any():
        return "flat"
    if slope.all():
        return "hip"
    if (angle == 0).any():
        return "mixed"
    along = np.concatenate([np.roll(ring, -1, axis=0) - ring for ring in rings])[slope]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    return "shed" if (along @ along.T).min() >= _SHED_COSINE else "gable"

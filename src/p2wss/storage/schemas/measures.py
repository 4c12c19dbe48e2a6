"""Measures: Parquet of the errors of each building and method.

Written and read by the stage eval.
"""

import pyarrow as pa

from p2wss.storage.schemas.columns import IDENTITY, field

MEASURES = pa.schema(
    [
        field("dataset", pa.string(), "simulated (the test split) or real"),
        *IDENTITY,
        field("method", pa.string(), "as in the reconstructions"),
        field(
            "status",
            pa.string(),
            "'ok', or why the method gave no mesh: then there is none, or the flat roof of the product",
        ),
        field("num_points", pa.int32(), "points of the crop of the building"),
        field("num_vertices", pa.int32(), "vertices of the footprint, all rings"),
        field("density_per_m2", pa.float32(), "points inside the footprint, per m2 of its area"),
        field("roof_type", pa.string(), "label; null for real LiDAR", True),
        field(
            "roof_kind",
            pa.string(),
            "kind of roof by the angles of the reconstruction; null without any",
            True,
        ),
        field("visible_roof_share", pa.float32(), "as in the crop"),
        field("num_parts", pa.int32(), "bodies between which there are steps; null without a mesh", True),
        field(
            "num_triangles", pa.int32(), "triangles of the mesh, ground included; null without a mesh", True
        ),
        field("watertight", pa.bool_(), "every edge has two triangles; null without a mesh", True),
        field(
            "manifold",
            pa.bool_(),
            "watertight, consistently oriented, and the triangles at each vertex form one fan; null without a mesh",
            True,
        ),
        field(
            "planar",
            pa.bool_(),
            "the vertices of each face are within 1 cm of a plane; null without a mesh",
            True,
        ),
        field("chamfer_m", pa.float32(), "Chamfer distance of the paper: cloud to whole mesh", True),
        field(
            "roof_chamfer_m",
            pa.float32(),
            "Chamfer distance of the points on the building to the roof faces; null with fewer than 10 points",
            True,
        ),
        field(
            "points_to_mesh_m", pa.float32(), "mean distance of the points on the building to the mesh", True
        ),
        field(
            "height_rmse_m",
            pa.float32(),
            "root mean square height above the roof of the points 0.5 m or more inside the footprint",
            True,
        ),
        field(
            "false_edge_share",
            pa.float32(),
            "of the length of the roof's edges, further than 0.5 m from any of the label's; null without label",
            True,
        ),
        field(
            "missing_edge_share",
            pa.float32(),
            "of the length of the edges of the label's roof, further than 0.5 m from any edge of the roof",
            True,
        ),
        field(
            "height_error_m", pa.float32(), "absolute error of the z of the eave; null without label", True
        ),
        field("is_height_seen", pa.bool_(), "ten points or more are on the building"),
        field(
            "angle_error_deg",
            pa.list_(pa.float32()),
            "absolute error per edge; null without label, or with other edges than the label",
            True,
        ),
        field(
            "is_angle_seen",
            pa.list_(pa.bool_()),
            "per edge: ten points or more show its angle (p2wss.eval.measure.seen_edges)",
            True,
        ),
        field(
            "coordinate_error_m",
            pa.list_(pa.float32()),
            "absolute errors of the vertices, alternating x and y; null where the footprint is given",
            True,
        ),
    ]
)

"""Measures: Parquet with one row per building and method."""

from __future__ import annotations

import pyarrow as pa

from p2wss.data.schemas.columns import IDENTITY, field

MEASURES = pa.schema(
    [
        field("dataset", pa.string(), "simulated (the test split) or real"),
        *IDENTITY,
        field("method", pa.string(), "point2wss, point2wss+fit, fit, lod1, constant or roofer"),
        field(
            "status",
            pa.string(),
            "'ok', or why the method gave no mesh: then there is none, or the flat roof of the product",
        ),
        field("num_points", pa.int32(), "points of the building's cloud"),
        field("num_vertices", pa.int32(), "vertices of the building's footprint, all rings"),
        field("density_per_m2", pa.float32(), "points inside the footprint, per m2 of it"),
        field("roof_type", pa.string(), "label; null for real LiDAR", True),
        field("roof_kind", pa.string(), "by the angles of this reconstruction; null where it has none", True),
        field("visible_roof_share", pa.float32(), "as in the crop"),
        field("confidence", pa.float32(), "expected share of right numbers; null where unknown", True),
        field(
            "num_parts", pa.int32(), "of the reconstruction, with a height each; null without a mesh", True
        ),
        field("num_triangles", pa.int32(), "of the whole mesh, ground included; null without a mesh", True),
        field("num_mesh_vertices", pa.int32(), "different ones of the mesh; null without a mesh", True),
        field("watertight", pa.bool_(), "every edge has two triangles; null without a mesh", True),
        field("oriented", pa.bool_(), "and they agree on the outside; null without a mesh", True),
        field(
            "manifold",
            pa.bool_(),
            "watertight, oriented, and the triangles at each vertex form one fan; null without a mesh",
            True,
        ),
        field(
            "planar",
            pa.bool_(),
            "every face's vertices lie within 1 cm of one plane; null without a mesh",
            True,
        ),
        field("num_small_faces", pa.int32(), "roof faces and walls below 0.25 m2; null without a mesh", True),
        field("chamfer_m", pa.float32(), "CD of the paper: cloud against the whole mesh", True),
        field(
            "roof_chamfer_m",
            pa.float32(),
            "CD of the points on the building against roof faces only; null with fewer than 10 such points",
            True,
        ),
        field("points_to_mesh_m", pa.float32(), "mean distance of those points to the mesh", True),
        field("far_share", pa.float32(), "share of those points more than 0.5 m from the mesh", True),
        field(
            "height_rmse_m",
            pa.float32(),
            "root mean square of the heights over the roof of those 0.5 m or more inside the footprint",
            True,
        ),
        field("height_bias_m", pa.float32(), "median of the same heights: positive = roof too low", True),
        field(
            "overshoot_m",
            pa.float32(),
            "highest point of the mesh above the highest of those points, negative below it",
            True,
        ),
        field("height_error_m", pa.float32(), "absolute error of the eave's z; null without label", True),
        field(
            "angle_error_deg", pa.float32(), "mean absolute error over the edges; null without label", True
        ),
        field(
            "right_share",
            pa.float32(),
            "share of the height and the angles within 0.5 m and 5 degrees; null without label",
            True,
        ),
    ]
)

"""Measures of the meshes of buildings: heights and areas of roofs and walls, volume, party walls."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import shapely

from p2wss.clouds.cropping import seen_share_of_cells
from p2wss.mesh import Mesh
from p2wss.mesh.surface import topmost
from p2wss.mesh.topology import NEXT
from p2wss.skeleton.angles import bearings
from p2wss.skeleton.compiled import entry
from p2wss.skeleton.types import FaceKind

# planes with less slope are flat
FLAT_DEG = 3.0
FLAT, FLATS, SHED, GABLE, HIP, PYRAMID, SLOPES = (
    "flat", "several-flats", "shed", "gable", "hip", "pyramid", "several-slopes",
)  # fmt: skip
# planes with a smaller share of the roof do not count for its type; slopes face away from each other if their
# directions are less than 20 degrees from opposite
_SMALL_SHARE, _OPPOSITE_COSINE = 0.01, -np.cos(np.radians(20))
# the eaves of a hip roof differ by less than this share of the roof's height; a ridge shorter than this share of a hip
# is a point
_EVEN_SHARE, _POINT_SHARE = 0.2, 0.1
# walls within this distance of each other, and with directions up to this angle apart, stand against each other
_PARTY_M, _PARTY_COSINE = 0.1, -np.cos(np.radians(5))
_BISECTIONS = 24
# the walls of at most this many buildings are kept while pairs are measured
_MAX_WALLS = 4096


@dataclass(frozen=True)
class MeshMeasures:
    """Measures of a building's mesh; heights in the height system of the cloud.

    roof_type: ``flat`` (one level plane), ``several-flats``, ``shed``, ``gable``, ``hip``, ``pyramid``, or
    ``several-slopes`` (all others); planes below 3 degrees are level. roof_z_min_m, roof_z_max_m: lowest and highest
    point of the roof. roof_z_p50_m, roof_z_p70_m: height below which 50 and 70 % of the roof lie, by area in plan.
    ridge_z_m: highest point of the convex edges between two sloped planes of the roof; None without such an edge.
    outer_floor_area_m2: open ground within the footprint, which is no roof. wall_area_m2: party walls included.
    """

    roof_type: str
    roof_z_min_m: float
    roof_z_p50_m: float
    roof_z_p70_m: float
    roof_z_max_m: float
    ridge_z_m: float | None
    volume_m3: float
    ground_area_m2: float
    flat_roof_area_m2: float
    sloped_roof_area_m2: float
    wall_area_m2: float
    outer_floor_area_m2: float


def measure(mesh: Mesh) -> MeshMeasures:
    """The measures of a closed mesh."""
    corner = mesh.corner_m - mesh.vertex_m.min(axis=0)
    is_roof = (mesh.kind == FaceKind.ROOF) | (mesh.kind == FaceKind.FLAT)
    area, face = mesh.area_m2, mesh.face
    # slopes are of whole faces, as their triangles may be slivers
    total = np.zeros((int(face.max()) + 1, 3))
    np.add.at(total, face, mesh.doubled_m2)
    slope_deg = np.degrees(bearings(np.column_stack([total[:, 2], np.hypot(total[:, 0], total[:, 1])])))[face]
    is_sloped = is_roof & (slope_deg >= FLAT_DEG)
    roof_faces, meetings = np.unique(face[is_roof]), _meetings(mesh, is_sloped)
    roof_type = FLATS if len(roof_faces) > 1 else FLAT
    if is_sloped.any():
        roof_type = _sloped_type(mesh, is_sloped, roof_faces, total[roof_faces], meetings)
    base_z = float(mesh.vertex_m[:, 2].min())
    z = np.sort(corner[is_roof, :, 2], axis=1)
    p50, p70 = (_height_quantile(z, np.abs(mesh.doubled_m2[is_roof, 2]), share) for share in (0.5, 0.7))
    return MeshMeasures(
        roof_type,
        base_z + float(z.min()),
        base_z + p50,
        base_z + p70,
        base_z + float(z.max()),
        float(meetings.top_z[meetings.is_convex].max()) if meetings.is_convex.any() else None,
        mesh.volume_m3,
        float(area[mesh.kind == FaceKind.GROUND].sum()),
        float(area[is_roof & ~is_sloped].sum()),
        float(area[is_sloped].sum()),
        float(area[mesh.kind == FaceKind.WALL].sum()),
        float(area[mesh.kind == FaceKind.FLOOR].sum()),
    )


@entry
def _height_quantile(z: np.ndarray, weight: np.ndarray, share: float) -> float:
    """The height below which a share of the area in plan of triangles lies. z: (t, 3), ascending heights of the corners
    of each triangle. weight: (t,), areas in plan."""
    low_end, high_end, target = z.min(), z.max(), share * weight.sum()
    for _ in range(_BISECTIONS):
        at, below = (low_end + high_end) / 2, 0.0
        for t in range(len(z)):
            low, middle, high = z[t]
            if at >= high:
                below += weight[t]
            elif at > middle:
                below += weight[t] * (1 - (high - at) ** 2 / ((high - low) * (high - middle)))
            elif at > low:
                below += weight[t] * (at - low) ** 2 / ((middle - low) * (high - low))
        if below < target:
            low_end = at
        else:
            high_end = at
    return float(high_end)


class _Meetings(NamedTuple):
    """Edges between two sloped planes of a roof; each edge is there twice, once from either side. face: (e, 2), the two
    planes. is_convex, length_m: (e,). top_z: (e,), height of the upper end."""

    face: np.ndarray
    is_convex: np.ndarray
    length_m: np.ndarray
    top_z: np.ndarray


def _meetings(mesh: Mesh, is_sloped: np.ndarray) -> _Meetings:
    triangle, side = np.nonzero((mesh.twin >= 0) & is_sloped[:, None] & is_sloped[mesh.twin // 3])
    beyond, side_beyond = np.divmod(mesh.twin[triangle, side], 3)
    between = mesh.face[triangle] != mesh.face[beyond]
    triangle, side, beyond, side_beyond = (each[between] for each in (triangle, side, beyond, side_beyond))
    # an edge is convex if the third corner of the second triangle is below the plane of the first triangle
    apex = mesh.corner_m[beyond, (side_beyond + 2) % 3]
    start, end = mesh.corner_m[triangle, side], mesh.corner_m[triangle, NEXT[side]]
    height = np.einsum("ij,ij->i", apex - start, mesh.doubled_m2[triangle])
    face = np.column_stack([mesh.face[triangle], mesh.face[beyond]])
    return _Meetings(face, height < 0, np.linalg.norm(end - start, axis=1), np.maximum(start, end)[:, 2])


def _sloped_type(
    mesh: Mesh, is_sloped: np.ndarray, roof_faces: np.ndarray, normal_m2: np.ndarray, meetings: _Meetings
) -> str:
    """The type of a roof with slopes, by its planes and where they meet. is_sloped: bool (t,), per triangle.
    roof_faces: (f,). normal_m2: (f, 3), normals as long as the doubled areas of the faces."""
    area_m2 = np.linalg.norm(normal_m2, axis=1)
    is_main = area_m2 > _SMALL_SHARE * area_m2.sum()
    main, down = roof_faces[is_main], normal_m2[is_main, :2]
    is_one = np.zeros(int(mesh.face.max()) + 1, bool)
    is_one[main] = True
    among = is_one[meetings.face].all(axis=1)
    is_one[mesh.face[is_sloped]] = False
    # no named type: no plane is large, a large plane is level, or large planes meet in a concave edge
    if not len(main) or is_one.any() or not meetings.is_convex[among].all():
        return SLOPES
    if len(main) == 1:
        return SHED
    # a symmetric matrix, as each edge is there from both sides
    length_m = np.zeros((len(main), len(main)))
    np.add.at(length_m, tuple(np.searchsorted(main, meetings.face[among]).T), meetings.length_m[among])
    down = down / np.linalg.norm(down, axis=1, keepdims=True)
    is_opposite = down @ down.T < _OPPOSITE_COSINE
    if len(main) == 2:
        return GABLE if is_opposite[0, 1] and length_m[0, 1] > 0 else SLOPES
    z = [mesh.corner_m[mesh.face == plane, :, 2] for plane in main]
    eave_z, top_z = np.array([each.min() for each in z]), max(each.max() for each in z)
    is_even = np.ptp(eave_z) < _EVEN_SHARE * (top_z - eave_z.min())
    hip_m, ridge_m = length_m[~(is_opposite | np.eye(len(main), dtype=bool))], length_m[is_opposite]
    if len(main) != 4 or len(ridge_m) != 4 or hip_m.min() == 0 or not is_even:
        return SLOPES
    return HIP if ridge_m.max() > _POINT_SHARE * hip_m.max() else PYRAMID


def unseen_roof_area_m2(mesh: Mesh, x_m: np.ndarray, y_m: np.ndarray) -> float:
    """The area in plan of the roof of a mesh in 1 m cells without a point. x_m, y_m: (n,), the points, in the frame of
    the mesh. Open ground within the footprint is no roof."""
    is_roof = (mesh.kind == FaceKind.ROOF) | (mesh.kind == FaceKind.FLAT)
    corner_m = mesh.corner_m[is_roof]
    low_x, low_y = np.floor(corner_m[..., :2].min(axis=(0, 1))).astype(int).tolist()
    high_x, high_y = np.floor(corner_m[..., :2].max(axis=(0, 1))).astype(int).tolist()
    x, y = np.meshgrid(np.arange(low_x, high_x + 1) + 0.5, np.arange(low_y, high_y + 1) + 0.5)
    centre_m = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    inside = (topmost(corner_m, centre_m)[0] >= 0).reshape(x.shape)
    share = seen_share_of_cells(inside, (low_x, low_y), x_m, y_m)
    return float(mesh.doubled_m2[is_roof, 2].sum()) / 2 * (1.0 - share)


def party_wall_areas_m2(meshes: Sequence[Mesh | None]) -> np.ndarray:
    """float64 (b,): the area of the walls of each building that stand against walls of other buildings: within 0.1 m,
    and opposite within 5 degrees. 0 without a mesh. meshes: may be computed at each access."""
    result = np.zeros(len(meshes))
    box_m = np.full((len(meshes), 4), np.nan)
    for i, mesh in enumerate(meshes):
        if mesh is not None:
            box_m[i] = [*mesh.vertex_m[:, :2].min(axis=0), *mesh.vertex_m[:, :2].max(axis=0)]
    usable = np.flatnonzero(np.isfinite(box_m[:, 0]))
    boxes = shapely.box(*box_m[usable].T)
    pairs = np.sort(usable[shapely.STRtree(boxes).query(boxes, predicate="dwithin", distance=_PARTY_M)].T)
    walls = lru_cache(_MAX_WALLS)(lambda i: _walls(meshes[i]))
    for a, b in np.unique(pairs[pairs[:, 0] < pairs[:, 1]], axis=0).tolist():
        result[[a, b]] += _common_area_m2(*walls(a), *walls(b))
    return result


def _walls(mesh: Mesh | None) -> tuple[np.ndarray, np.ndarray]:
    """(corners (t, 3, 3), unit normals in plan (t, 2)) of the triangles of walls."""
    assert mesh is not None
    is_wall = mesh.kind == FaceKind.WALL
    corner, normal = mesh.corner_m[is_wall], mesh.doubled_m2[is_wall, :2]
    length = np.linalg.norm(normal, axis=1)
    is_upright = length > 1e-6
    return corner[is_upright], normal[is_upright] / length[is_upright, None]


def _common_area_m2(
    corner_a: np.ndarray, normal_a: np.ndarray, corner_b: np.ndarray, normal_b: np.ndarray
) -> float:
    """The area in which walls of one building touch walls of another, m2; both as :func:`_walls` returns them."""
    a, b = np.nonzero(normal_a @ normal_b.T < _PARTY_COSINE)
    # across and along the wall of the first
    axes = np.stack([normal_a[a], normal_a[a, ::-1] * (-1, 1)], axis=2)
    place_a, place_b = ((each[..., :2] - corner_a[a, :1, :2]) @ axes for each in (corner_a[a], corner_b[b]))
    # one corner near is enough, as a triangle may be longer than the wall that it faces
    is_near = np.abs(place_b[..., 0]).min(axis=1) <= _PARTY_M
    first, second = (
        shapely.polygons(np.stack([place[..., 1], corner[..., 2]], axis=2)[is_near])
        for place, corner in ((place_a, corner_a[a]), (place_b, corner_b[b]))
    )
    return float(shapely.area(shapely.intersection(first, second)).sum())

"""The rules of ISO 19107 for solids, tested anew: with GEOS, scipy and integers of any size, and no code of ours.

The codes and the default tolerances are those of val3dity: vertices within 1 mm are one, faces are planar within
1 cm and 20 degrees, and are triangulated by constrained Delaunay triangulations of their plane of least squares.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree

SNAP_M, PLANAR_M, FOLD_DEG = 1e-3, 1e-2, 20.0
Point = tuple[int, int, int]


def codes_of_text(text: str) -> dict[str, list[int]]:
    """The broken rules of each solid of a CityJSONSeq, by building id and level of detail ("id 2.0")."""
    header, *features = map(json.loads, text.splitlines())
    scale = header["transform"]["scale"][0]
    result = {}
    for feature in features:
        vertices = [tuple(vertex) for vertex in feature["vertices"]]
        for name, city_object in feature["CityObjects"].items():
            for geometry in city_object.get("geometry", []):
                (shell,) = geometry["boundaries"]
                result[f"{name} {geometry['lod']}"] = codes(vertices, shell, scale)
    return result


def codes(vertices: list[Any], shell: list[list[list[int]]], scale: float) -> list[int]:
    """The broken rules of a solid, sorted. vertices: integers in units of ``scale`` metres. shell: faces of rings."""
    xyz_m = np.array(vertices, float) * scale
    xyz_m -= xyz_m.min(axis=0)
    found = set()
    used = sorted({vertex for rings in shell for ring in rings for vertex in ring})
    if cKDTree(xyz_m[used]).query_pairs(SNAP_M):
        found.add(102)
    triangles: list[tuple[int, int, int]] = []
    for rings in shell:
        of_face, its_triangles = _face(xyz_m, vertices, rings)
        found |= of_face
        triangles += its_triangles
    if found:
        return sorted(found)
    if len(shell) < 4:
        return [301]
    found |= _topology(triangles)
    if not found and _intersects(vertices, triangles):
        found.add(306)
    if not found and sum(_det(*(vertices[v] for v in corner)) for corner in triangles) <= 0:
        found.add(405)
    return sorted(found)


def _face(
    xyz_m: np.ndarray, vertices: list[Point], rings: list[list[int]]
) -> tuple[set[int], list[tuple[int, int, int]]]:
    """(broken rules of one face, its triangles)."""
    if not rings or min(map(len, rings)) < 3:
        return {101}, []
    if any(a == b for ring in rings for a, b in pairwise([*ring, ring[0]])):
        return {102}, []
    corner = [vertex for ring in rings for vertex in ring]
    if len(corner) == 3:
        a, b, c = (np.array(vertices[v], dtype=object) for v in corner)
        return (set() if any(_cross(b - a, c - a)) else {104}), [(corner[0], corner[1], corner[2])]
    centre = xyz_m[corner].mean(axis=0)
    axes = np.linalg.svd(xyz_m[corner] - centre)[2]
    if np.abs((xyz_m[corner] - centre) @ axes[2]).max() > PLANAR_M:
        return {203}, []
    if _newell(xyz_m[rings[0]]) @ np.cross(axes[0], axes[1]) < 0:
        axes[0] *= -1
    plane = {vertex: tuple((xyz_m[vertex] - centre) @ axes[:2].T) for vertex in corner}
    flat = [shapely.LinearRing([plane[vertex] for vertex in ring]) for ring in rings]
    if not all(ring.is_simple for ring in flat):
        return {104}, []
    if not flat[0].is_ccw or any(ring.is_ccw for ring in flat[1:]):
        return {208}, []
    polygon = shapely.Polygon(flat[0], flat[1:])
    if not polygon.is_valid:
        reason = shapely.is_valid_reason(polygon)
        names = {"Hole lies": 206, "Holes are": 207, "Interior": 205, "Duplicate": 202}
        return {next((code for name, code in names.items() if reason.startswith(name)), 201)}, []
    by_place = {place: vertex for vertex, place in plane.items()}
    triangles = []
    for triangle in shapely.constrained_delaunay_triangles(polygon).geoms:
        a, b, c = (by_place[place] for place in list(triangle.exterior.coords)[:3])
        triangles.append((a, b, c) if triangle.exterior.is_ccw else (a, c, b))
    normals = np.array([_newell(xyz_m[list(corners)]) for corners in triangles])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    folds = np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1)))
    return ({204} if folds.max() > FOLD_DEG else set()), triangles


def _newell(ring_m: np.ndarray) -> np.ndarray:
    local = ring_m - ring_m[0]
    return np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)


def _topology(triangles: list[tuple[int, int, int]]) -> set[int]:
    sides = Counter((a, b) for corners in triangles for a, b in pairwise([*corners, corners[0]]))
    around = Counter(frozenset(side) for side in sides.elements())
    if max(around.values()) > 2:
        return {303}
    if min(around.values()) < 2:
        return {302}
    if max(sides.values()) > 1:
        return {307}
    fans: dict[int, list[set[int]]] = defaultdict(list)
    parts: list[set[int]] = []
    for corners in triangles:
        for k in range(3):
            fans[corners[k]].append({corners[k - 1], corners[k - 2]})
        parts.append(set(corners))
    if any(len(_joined(fan)) > 1 for fan in fans.values()):
        return {303}
    return {305} if len(_joined(parts)) > 1 else set()


def _joined(groups: list[set[int]]) -> list[set[int]]:
    """Groups that have a member in common, united."""
    result: list[set[int]] = []
    for group in groups:
        apart = []
        for other in result:
            if other & group:
                group = group | other
            else:
                apart.append(other)
        result = [*apart, group]
    return result


def _intersects(vertices: list[Point], triangles: list[tuple[int, int, int]]) -> bool:
    return any(
        _pair_intersects(vertices, set(triangles[i]), set(triangles[j]), triangles[i], triangles[j])
        for i, j in _near_pairs(np.array(vertices), np.array(triangles))
    )


def _near_pairs(vertex: np.ndarray, triangle: np.ndarray) -> Iterator[tuple[int, int]]:
    low, high = vertex[triangle].min(axis=1), vertex[triangle].max(axis=1)
    near = ((low[:, None] <= high) & (low <= high[:, None])).all(axis=2)
    # triangles wholly on one side of the plane of the other, unless rounding could decide
    corner = vertex[triangle].astype(float)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    height = np.einsum("ijkd,id->ijk", corner[None] - corner[:, None, :1], normal)
    beside = (height.min(axis=2) > 1e-3) | (height.max(axis=2) < -1e-3)
    i, j = np.nonzero(near & ~beside & ~beside.T)
    return ((int(a), int(b)) for a, b in zip(i, j, strict=True) if a < b)


def _pair_intersects(
    vertices: list[Point], one: set[int], two: set[int], first: tuple[int, ...], second: tuple[int, ...]
) -> bool:
    common = one & two
    a, b = [vertices[v] for v in first], [vertices[v] for v in second]
    if len(common) == 3:
        return True
    if len(common) == 2:
        (p, q), (c,), (d,) = ([vertices[v] for v in part] for part in (common, one - two, two - one))
        if _orient(p, q, c, d):
            return False
        axis = _clear_axis(p, q, c)
        return _orient2(p, q, c, axis) * _orient2(p, q, d, axis) > 0
    if len(common) == 1:
        far_a, far_b = ([vertices[v] for v in part - common] for part in (one, two))
        return _segment_meets(*far_a, b) or _segment_meets(*far_b, a)
    return any(_segment_meets(p, q, b) for p, q in combinations(a, 2)) or any(
        _segment_meets(p, q, a) for p, q in combinations(b, 2)
    )


def _segment_meets(p: Point, q: Point, triangle: list[Point]) -> bool:
    """Whether a segment and a triangle have a point in common, exactly."""
    a, b, c = triangle
    p_side, q_side = _orient(a, b, c, p), _orient(a, b, c, q)
    if p_side * q_side > 0:
        return False
    if p_side == q_side == 0:
        axis = _clear_axis(a, b, c)
        if any(_segments_meet(p, q, *edge, axis) for edge in ((a, b), (b, c), (c, a))):
            return True
        sides = [_orient2(*edge, p, axis) for edge in ((a, b), (b, c), (c, a))]
        return min(sides) > 0 or max(sides) < 0
    sides = [_orient(p, q, *edge) for edge in ((a, b), (b, c), (c, a))]
    return min(sides) >= 0 or max(sides) <= 0


def _segments_meet(p: Point, q: Point, a: Point, b: Point, axis: int) -> bool:
    one, two = _orient2(p, q, a, axis), _orient2(p, q, b, axis)
    three, four = _orient2(a, b, p, axis), _orient2(a, b, q, axis)
    if one * two > 0 or three * four > 0:
        return False
    if one == two == three == four == 0:
        return all(
            max(min(p[k], q[k]), min(a[k], b[k])) <= min(max(p[k], q[k]), max(a[k], b[k])) for k in range(3)
        )
    return True


def _clear_axis(a: Point, b: Point, c: Point) -> int:
    """An axis along which the triangle is seen as one."""
    normal = _cross(np.array(b, dtype=object) - a, np.array(c, dtype=object) - a)
    return max(range(3), key=lambda k: abs(normal[k]))


def _orient2(a: Point, b: Point, c: Point, axis: int) -> int:
    x, y = (axis + 1) % 3, (axis + 2) % 3
    return (b[x] - a[x]) * (c[y] - a[y]) - (b[y] - a[y]) * (c[x] - a[x])


def _orient(a: Point, b: Point, c: Point, d: Point) -> int:
    return _det(*([p - q for p, q in zip(point, a, strict=True)] for point in (b, c, d)))


def _det(a: Any, b: Any, c: Any) -> int:
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        - a[1] * (b[0] * c[2] - b[2] * c[0])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def _cross(u: Any, v: Any) -> list[int]:
    return [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]

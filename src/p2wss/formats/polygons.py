"""Triangles back to planar polygons with holes, as CityJSON stores them."""

from __future__ import annotations

import numpy as np

from p2wss.formats.cityjson import Surface


def planar_surfaces(
    vertex_m: np.ndarray, triangle: np.ndarray, kind: np.ndarray, edge: np.ndarray
) -> list[Surface]:
    """Polygons of a closed mesh whose triangles of one plane share their kind and edge, as the kernel's do.

    vertex_m (v, 3), triangle (t, 3), kind and edge (t,). Triangles of one kind and edge that share an edge
    become one polygon; its exterior ring comes first, every ring runs as its triangles do. Vertices on a
    straight side stay, where a neighbour has a corner.
    """
    half = {}
    for t, corners in enumerate(np.asarray(triangle).tolist()):
        for i in range(3):
            half[corners[i], corners[(i + 1) % 3]] = t
    label = list(zip(np.asarray(kind).tolist(), np.asarray(edge).tolist(), strict=True))
    group = np.full(len(label), -1)
    surfaces: list[Surface] = []
    for first in range(len(label)):
        if group[first] < 0:
            number = len(surfaces)
            members = _grow(first, number, np.asarray(triangle), half, label, group)
            rings = _rings(members, np.asarray(triangle), half, group, number)
            normal = np.cross(
                vertex_m[triangle[members, 1]] - vertex_m[triangle[members, 0]],
                vertex_m[triangle[members, 2]] - vertex_m[triangle[members, 0]],
            ).sum(axis=0)
            # only the exterior turns around the face's normal
            rings.sort(key=lambda ring, n=normal: -_turning(np.asarray(vertex_m)[ring], n))  # type: ignore[misc]
            surfaces.append(Surface(*label[first], [np.array(ring) for ring in rings]))
    return surfaces


def _grow(
    first: int,
    number: int,
    triangle: np.ndarray,
    half: dict[tuple[int, int], int],
    label: list[tuple[int, int]],
    group: np.ndarray,
) -> list[int]:
    members, pending = [], [first]
    group[first] = number
    while pending:
        t = pending.pop()
        members.append(t)
        corners = triangle[t].tolist()
        for i in range(3):
            other = half.get((corners[(i + 1) % 3], corners[i]))
            if other is not None and group[other] < 0 and label[other] == label[first]:
                group[other] = number
                pending.append(other)
    return members


def _rings(
    members: list[int],
    triangle: np.ndarray,
    half: dict[tuple[int, int], int],
    group: np.ndarray,
    number: int,
) -> list[list[int]]:
    """Boundary loops: from one boundary edge to the next by turning around their common vertex inside the
    polygon, so that rings that touch in a vertex stay apart."""

    def is_boundary(a: int, b: int) -> bool:
        other = half.get((b, a))
        return other is None or group[other] != number

    def following(a: int, b: int) -> tuple[int, int]:
        t = half[a, b]
        while True:
            corners = triangle[t].tolist()
            c = corners[(corners.index(b) + 1) % 3]
            if is_boundary(b, c):
                return b, c
            t = half[c, b]

    left = {
        (int(triangle[t, i]), int(triangle[t, (i + 1) % 3])): None
        for t in members
        for i in range(3)
        if is_boundary(int(triangle[t, i]), int(triangle[t, (i + 1) % 3]))
    }
    rings = []
    while left:
        start = next(iter(left))
        ring, here = [], start
        while here in left:
            del left[here]
            ring.append(here[0])
            here = following(*here)
        rings.append(ring)
    return rings


def _turning(ring_m: np.ndarray, normal: np.ndarray) -> float:
    """Twice the ring's area, positive if it turns counter-clockwise about ``normal``, times its length."""
    local = ring_m - ring_m[0]
    return float(np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0) @ normal)

"""Roofs of neighbours that differ by centimetres at their common wall, moved as planes until they meet there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.meeting import turned_over, with_meeting_planes
from p2wss.mesh.topology import NEXT
from p2wss.reconstruct.skin.solids import faces_of, opposite_walls
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import FaceKind

# steps between neighbours lower than this are none, and no vertex moves further
MAX_STEP_M = 0.1
# planes do not meet if they are further than this from their point
_APART_M = 1e-4


@dataclass(frozen=True)
class _Step:
    """What is a little apart at a common wall: a vertex, and the vertex or else the plane of a neighbour that it is
    nearest to. gap_m: between them. other, plane: -1 for none. buildings: of both."""

    gap_m: float
    vertex: int
    other: int
    plane: int
    buildings: tuple[int, int]


def with_common_roofs(solids: Sequence[Mesh], max_step_m: float = MAX_STEP_M) -> list[Mesh]:
    """Solids that touch, without those steps of less than ``max_step_m`` between their roofs, and between their inner
    walls, that vanish if planes move so that they meet at the common wall.

    Only planes move: roofs stay planar, walls upright, outer walls and floors where they are. Steps stay, the highest
    first, where a vertex would move further than ``max_step_m`` or a triangle turn over.
    """
    mesh = Mesh.joined(solids)
    building = np.repeat(np.arange(len(solids)), [len(solid.vertex_m) for solid in solids])
    steps = _steps(mesh, solids, building, max_step_m)
    moved, is_wrong = mesh, bool(steps)
    while is_wrong:
        linked = np.array([(step.vertex, step.other) for step in steps if step.other >= 0], int).reshape(
            -1, 2
        )
        through = [(step.vertex, step.plane) for step in steps if step.plane >= 0]
        moved, apart_m = with_meeting_planes(mesh, groups(len(building), linked), through)
        is_bad = np.linalg.norm(moved.vertex_m - mesh.vertex_m, axis=1) > max_step_m
        is_bad |= apart_m > _APART_M
        is_bad[mesh.triangle[turned_over(moved, mesh)]] = True
        worst: dict[int, tuple[bool, float, int]] = {}
        for number, step in enumerate(steps):
            rank = bool(is_bad[step.vertex] or (step.other >= 0 and is_bad[step.other])), step.gap_m, number
            for each in step.buildings:
                worst[each] = max(worst.get(each, rank), rank)
        gone = {worst[each][2] for each in set(building[is_bad].tolist()) & worst.keys()}
        is_wrong = bool(gone)
        steps = [step for number, step in enumerate(steps) if number not in gone]
    place_m = np.split(moved.vertex_m, np.cumsum([len(solid.vertex_m) for solid in solids])[:-1])
    joined = {each for step in steps for each in step.buildings}
    return [
        solid.moved(vertex_m) if number in joined else solid
        for number, (solid, vertex_m) in enumerate(zip(solids, place_m, strict=True))
    ]


def _steps(mesh: Mesh, solids: Sequence[Mesh], building: np.ndarray, max_step_m: float) -> list[_Step]:
    """The steps of less than ``max_step_m`` between solids that touch. mesh: all of them. building: of its vertices."""
    planes = mesh.planes
    point, faces = faces_of(solids)
    # floors and the walls on them stay
    on_floor, on_moving = np.zeros((2, len(mesh.vertex_m)), bool)
    on_floor[mesh.triangle[mesh.kind == FaceKind.GROUND]] = True
    moves = np.ones(len(planes.kind), bool)
    moves[mesh.number[on_floor[mesh.triangle].any(axis=1)]] = False
    on_moving[mesh.triangle[moves[mesh.number]]] = True
    is_free, may_move = on_moving.tolist(), moves.tolist()
    ends = np.column_stack([mesh.triangle.ravel(), mesh.triangle[:, NEXT].ravel()]).tolist()
    beyond = dict(zip(map(tuple, ends), np.repeat(mesh.number, 3).tolist(), strict=True))
    found: dict[tuple[int, int, int], _Step] = {}
    for pair in opposite_walls(point, faces).tolist():
        rings = [faces[wall].rings for wall in pair]
        corners = [[v for ring in each for v in ring if is_free[v]] for each in rings]
        if not all(corners):
            continue
        gap_m = np.linalg.norm(point[corners[0]][:, None] - point[corners[1]], axis=2)
        for mine, theirs, gaps_m in ((0, 1, gap_m), (1, 0, gap_m.T)):
            edges = [
                (b, a) for ring in rings[theirs] for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)
            ]
            edge = np.array([each for each in edges if may_move[beyond[each]]], int).reshape(-1, 2)
            nearest = gaps_m.argmin(axis=1)
            for k, vertex in enumerate(corners[mine]):
                other, plane, least_m = corners[theirs][nearest[k]], -1, gaps_m[k, nearest[k]]
                if least_m >= max_step_m or gaps_m[:, nearest[k]].argmin() != k:
                    start, along = point[edge[:, 0]], point[edge[:, 1]] - point[edge[:, 0]]
                    share = ((point[vertex] - start) * along).sum(axis=1) / (along**2).sum(axis=1)
                    away_m = np.linalg.norm(point[vertex] - start - share[:, None] * along, axis=1)
                    away_m[(share <= 0) | (share >= 1)] = np.inf
                    least_m = away_m.min(initial=np.inf)
                    if least_m >= max_step_m:
                        continue
                    other, plane = -1, beyond[tuple(edge[away_m.argmin()].tolist())]
                buildings = int(building[vertex]), int(building[corners[theirs][0]])
                key = (vertex, other, plane) if vertex < other or other < 0 else (other, vertex, plane)
                found[key] = _Step(float(least_m), *key, buildings)
    return list(found.values())

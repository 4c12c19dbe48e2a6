"""Roofs and fronts of neighbours that differ by centimetres at their common wall. Planes that are the same but for
noise become one plane. Other planes move as a whole until they meet at the wall."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from p2wss.mesh import Mesh
from p2wss.mesh.meeting import turned_over, with_meeting_planes
from p2wss.mesh.topology import NEXT
from p2wss.reconstruction.skin.solids import faces_of, opposite_walls
from p2wss.skeleton.groups import groups
from p2wss.skeleton.types import FaceKind

# lower steps between neighbours are removed, as heights are often stated in tenths of a metre; no vertex moves further
# out of a plane
MAX_STEP_M = 0.12
# planes do not meet if one of them is further than this from their common point
_APART_M = 2e-4
# planes of neighbours may be one if the angle between them is less, and if no vertex is off the common plane by a step
_ONE_COSINE = np.cos(np.radians(3.0))


@dataclass(frozen=True)
class _Step:
    """A small step at a common wall: two vertices or two planes that become one, or a vertex and a plane that is moved
    to go through it.

    gap_m: the distance between both. vertices, planes: indices in the mesh of all solids. buildings: of both sides.
    """

    gap_m: float
    vertices: tuple[int, ...]
    planes: tuple[int, ...]
    buildings: tuple[int, int]


def with_common_roofs(solids: Sequence[Mesh]) -> list[Mesh]:
    """Touching solids without low steps (below :data:`MAX_STEP_M`) between their roofs, and between their inner walls.
    Planes are moved so that they meet at the common wall. Roofs, and walls, of neighbours that are one plane but for
    centimetres become one plane.

    Only whole planes move: roofs stay planar, and walls upright. Outer walls and floors stay in place, unless two walls
    become one. Where a vertex would leave a plane by more than :data:`MAX_STEP_M`, or a triangle would turn over, steps
    are left as they are, the highest first, until all is well.
    """
    mesh = Mesh.joined(solids)
    building = np.repeat(np.arange(len(solids)), [len(solid.vertex_m) for solid in solids])
    steps = _steps(mesh, solids, building)
    vertex_at, plane_at = mesh.at
    moved, is_wrong = mesh, bool(steps)
    while is_wrong:
        linked = [step.vertices for step in steps if len(step.vertices) == 2]
        one_plane = groups(len(mesh.planes.kind), _pairs([s.planes for s in steps if len(s.planes) == 2]))
        through = [
            (s.vertices[0], int(one_plane[s.planes[0]])) for s in steps if len(s.vertices) == len(s.planes)
        ]
        whole = replace(mesh, label=one_plane[mesh.number])
        moved, apart_m = with_meeting_planes(whole, groups(len(building), _pairs(linked)), through)
        is_bad = apart_m > _APART_M
        # only the movement out of a plane is limited: where roofs of nearly the same slope meet, a vertex may move far
        # along them
        off_m = ((moved.vertex_m - mesh.vertex_m)[vertex_at] * mesh.planes.normal[plane_at]).sum(axis=1)
        is_bad[vertex_at[np.abs(off_m) > MAX_STEP_M]] = True
        is_bad[mesh.triangle[turned_over(moved, mesh)]] = True
        is_bad_plane = np.zeros(len(one_plane), bool)
        is_bad_plane[plane_at[is_bad[vertex_at]]] = True
        worst: dict[int, tuple[bool, float, int]] = {}
        for number, step in enumerate(steps):
            at_step = is_bad[[*step.vertices]] if step.vertices else is_bad_plane[[*step.planes]]
            rank = bool(at_step.any()), step.gap_m, number
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


def _steps(mesh: Mesh, solids: Sequence[Mesh], building: np.ndarray) -> list[_Step]:
    """The steps of less than :data:`MAX_STEP_M` between touching solids, and the pairs of their planes that are one.
    mesh: all solids. building: the solid of each vertex."""
    planes = mesh.planes
    point, faces = faces_of(solids)
    # floors, and the walls that stand on them, stay
    on_floor, on_moving = np.zeros((2, len(mesh.vertex_m)), bool)
    on_floor[mesh.triangle[mesh.kind == FaceKind.GROUND]] = True
    moves = np.ones(len(planes.kind), bool)
    moves[mesh.number[on_floor[mesh.triangle].any(axis=1)]] = False
    on_moving[mesh.triangle[moves[mesh.number]]] = True
    is_free, may_move = on_moving.tolist(), moves.tolist()
    ends = np.column_stack([mesh.triangle.ravel(), mesh.triangle[:, NEXT].ravel()]).tolist()
    beyond = dict(zip(map(tuple, ends), np.repeat(mesh.number, 3).tolist(), strict=True))
    pairs = opposite_walls(point, faces).tolist()
    # for each wall, the half-edges of the faces beside it
    across = {
        wall: [(b, a) for ring in faces[wall].rings for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]
        for pair in pairs
        for wall in pair
    }
    party_walls = {beyond[edges[0][::-1]] for edges in across.values()}
    beside = {
        (beyond[one], beyond[other]): (faces[pair[0]].building, faces[pair[1]].building)
        for pair in pairs
        for one, other in product(*(across[wall] for wall in pair))
        if not {beyond[one], beyond[other]} & party_walls
    }
    found = {(step.vertices, step.planes): step for step in _one_planes(mesh, beside)}
    for pair in pairs:
        rings = [faces[wall].rings for wall in pair]
        corners = [[v for ring in each for v in ring if is_free[v]] for each in rings]
        if not all(corners):
            continue
        gap_m = np.linalg.norm(point[corners[0]][:, None] - point[corners[1]], axis=2)
        for mine, theirs, gaps_m in ((0, 1, gap_m), (1, 0, gap_m.T)):
            edge = _pairs([each for each in across[pair[theirs]] if may_move[beyond[each]]])
            nearest = gaps_m.argmin(axis=1)
            for k, vertex in enumerate(corners[mine]):
                other, plane, least_m = corners[theirs][nearest[k]], -1, gaps_m[k, nearest[k]]
                if least_m >= MAX_STEP_M or gaps_m[:, nearest[k]].argmin() != k:
                    start, along = point[edge[:, 0]], point[edge[:, 1]] - point[edge[:, 0]]
                    share = ((point[vertex] - start) * along).sum(axis=1) / (along**2).sum(axis=1)
                    away_m = np.linalg.norm(point[vertex] - start - share[:, None] * along, axis=1)
                    away_m[(share <= 0) | (share >= 1)] = np.inf
                    least_m = away_m.min(initial=np.inf)
                    if least_m >= MAX_STEP_M:
                        continue
                    other, plane = -1, beyond[tuple(edge[away_m.argmin()].tolist())]
                buildings = int(building[vertex]), int(building[corners[theirs][0]])
                both = (vertex,) if other < 0 else tuple(sorted((vertex, other)))
                step = _Step(float(least_m), both, (plane,) if other < 0 else (), buildings)
                found[step.vertices, step.planes] = step
    return list(found.values())


def _one_planes(mesh: Mesh, beside: Mapping[tuple[int, int], tuple[int, int]]) -> list[_Step]:
    """Pairs of planes of neighbours that are one plane but for centimetres: no vertex of the planes that become one is
    further than a step from their common plane. beside: pairs of planes at common walls, and the buildings of each."""
    planes, (vertex, plane) = mesh.planes, mesh.at
    order = np.argsort(plane, kind="stable")
    point_m = dict(enumerate(np.split(mesh.vertex_m[vertex[order]], np.cumsum(np.bincount(plane))[:-1])))

    def off_plane_m(point_m: np.ndarray, kind: int) -> float:
        """The largest distance of points (m, 3) from the plane fitted to all, which is upright for walls."""
        away_m = (point_m - point_m.mean(axis=0))[:, : 2 if kind == FaceKind.WALL else 3]
        return float(np.abs(away_m @ np.linalg.eigh(away_m.T @ away_m)[1][:, 0]).max())

    candidates = []
    for (one, other), buildings in beside.items():
        kind = planes.kind[one]
        # level roofs are among these: they move as a whole
        is_alike = kind == planes.kind[other] and kind in (FaceKind.ROOF, FaceKind.WALL)
        if is_alike and planes.normal[one] @ planes.normal[other] > _ONE_COSINE:
            gap_m = off_plane_m(np.concatenate([point_m[one], point_m[other]]), kind)
            candidates.append(_Step(gap_m, (), (one, other), buildings))
    # in a long row, planes are added to a group only while all of the group together are one plane
    result, first = [], {number: number for number in point_m}
    for step in sorted(candidates, key=lambda step: (step.gap_m, step.planes)):
        one, other = (_root(first, each) for each in step.planes)
        if one != other:
            together_m = np.concatenate([point_m[one], point_m[other]])
            if off_plane_m(together_m, planes.kind[one]) < MAX_STEP_M:
                result.append(step)
                first[other], point_m[one] = one, together_m
    return result


def _root(first: dict[int, int], number: int) -> int:
    """The plane that represents the group of a plane."""
    while first[number] != number:
        first[number] = number = first[first[number]]
    return number


def _pairs(pairs: Sequence[tuple[int, ...]]) -> np.ndarray:
    """int (n, 2)."""
    return np.array(pairs, int).reshape(-1, 2)

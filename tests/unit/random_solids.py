"""Solids as the product makes them, on given outlines and without points: parametric, and of planes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import shapely
import solid_rules

from p2wss import skeleton
from p2wss.config import Scenes
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction
from p2wss.fit.directions import directions
from p2wss.fit.parametric import kernel_angles
from p2wss.fit.planes.arrangement import arrange
from p2wss.fit.planes.lines import Line
from p2wss.fit.planes.solid import solid_below
from p2wss.fit.settings import THRESHOLDS
from p2wss.formats import cityjson
from p2wss.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces, without_straight_vertices
from p2wss.mesh.repair import surfaces_to_write
from p2wss.reconstruction.product import with_valid_solids
from p2wss.scenes.roofs import ANGLES_DEG, FootprintEdges, draw_angles
from p2wss.skeleton.types import Polygons

Rings = list[np.ndarray]
REGIMES = ("realistic", "uniform", "any")
MAX_ROOF_M = 12.0


def angles(rings: Rings, regime: str, name: str, seed: int) -> np.ndarray:
    """Angles of all edges. realistic: as scenes draw them. uniform: as the paper does. any: 0 to 90 degrees."""
    rng = np.random.default_rng([seed, *name.encode()])
    num = sum(map(len, rings))
    if regime == "uniform":
        return rng.choice(ANGLES_DEG, num).astype(float)
    if regime == "any":
        return kernel_angles(rng.uniform(0, 90, num))
    polygon = shapely.Polygon(rings[0], rings[1:])
    radius_m = float(shapely.maximum_inscribed_circle(polygon).length)
    edges = FootprintEdges.from_rings(rings, np.zeros(num, bool), radius_m)
    return draw_angles(edges, name, Scenes(seed=seed))[1]


def reconstruction(name: str, rings: Rings, eave_m: float, angle_deg: np.ndarray) -> Reconstruction | None:
    """A building of one roof by the kernel, where it has a solid."""
    meshes = skeleton.build(
        Polygons.from_rings([rings]), angle_deg, np.array([eave_m]), max_roof_height_m=MAX_ROOF_M
    )
    if meshes.status[0]:
        return None
    return _reconstruction(name, rings, eave_m, angle_deg, with_exact_faces(Mesh.of_kernel(meshes, 0)))


def _reconstruction(
    name: str,
    rings: Rings,
    eave_m: float,
    angle_deg: np.ndarray,
    mesh: Mesh,
    num_parts: int = 1,
) -> Reconstruction:
    # anywhere on the ground, so that rounding is not that of the outline
    x, y, z = np.random.default_rng([7, *name.encode()]).uniform(0, 1e6, 3)
    place = ((float(x), float(y)), float(z) / 1e4)
    return Reconstruction(name, "", "fit", reasons.OK, *place, rings, eave_m, angle_deg, mesh, num_parts)


def with_planes(name: str, rings: Rings, seed: int, num_lines: int, is_hard: bool) -> Reconstruction | None:
    """A building below the planes of :func:`below_planes`; None where they have no closed solid."""
    mesh = below_planes(name, rings, seed, num_lines, is_hard)
    if mesh is None:
        return None
    mesh = without_straight_vertices(with_exact_faces(mesh, THRESHOLDS.short_edge_m))
    return _reconstruction(name, rings, 5.0, np.zeros(sum(map(len, rings))), mesh)


def below_planes(name: str, rings: Rings, seed: int, num_lines: int, is_hard: bool) -> Mesh | None:
    """The solid below up to five planes, each over random ones of the cells into which lines divide the outline.

    is_hard: some planes and lines are nearly but not quite the same, and lines nearly reach corners.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    corner_m = np.concatenate(rings)
    bearing = directions(rings, 4.0)[0]
    lines = []
    for _ in range(num_lines):
        angle = bearing + rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)])
        place = rng.uniform(corner_m.min(axis=0), corner_m.max(axis=0))
        if is_hard and rng.random() < 0.5:
            place = rng.choice(corner_m) + _nearly(rng)
        normal = np.array([np.cos(angle), np.sin(angle)])
        lines.append(Line(normal, float(normal @ place)))
    plane = np.array([_plane(corner_m, bearing, rng) for _ in range(int(rng.integers(2, 6)))])
    if is_hard:
        plane[1:] = np.where(rng.random((len(plane) - 1, 1)) < 0.5, plane[:1], plane[1:])
        plane[1:, 2] += [_nearly(rng) for _ in plane[1:]]
    cells = arrange(rings, lines)
    label = rng.integers(len(plane), size=len(cells.middle_m))
    return solid_below(cells, label, plane, corner_m)


def _nearly(rng: np.random.Generator) -> float:
    """Zero, or a difference of millimetres to centimetres."""
    return float(rng.choice([0.0, 0.0, 5e-4, 2e-3, 8e-3, 0.03, 0.3, 2.0]) * rng.choice([-1, 1]))


def _plane(corner_m: np.ndarray, bearing: float, rng: np.random.Generator) -> np.ndarray:
    """A level or a sloping plane (3,) that is 2.5 to 9 m high at the lowest corner."""
    bearing += rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2])
    slope = rng.choice([0.0, np.tan(np.radians(rng.uniform(3, 60)))]) * np.array(
        [np.cos(bearing), np.sin(bearing)]
    )
    return np.array([*slope, rng.uniform(2.5, 9) - (corner_m @ slope).min()])


def courtyard(rings: Rings, rng: np.random.Generator) -> Rings | None:
    """The outline with a courtyard that is cut out of it; None where there is no room."""
    polygon = shapely.Polygon(rings[0], rings[1:])
    inner = polygon.buffer(-float(rng.uniform(1.5, 5)), join_style="mitre")
    if not isinstance(inner, shapely.Polygon) or inner.interiors or inner.area < 6 or len(rings) > 1:
        return None
    if shapely.minimum_clearance(inner) < 0.1:
        return None
    hole = shapely.get_coordinates(shapely.orient_polygons(inner, exterior_cw=True))[:-1]
    return [*rings, hole]


def validated(
    reconstructions: Sequence[Reconstruction],
) -> Iterator[tuple[Reconstruction, Reconstruction, list[int]]]:
    """(before, after the product's own checks, codes of the independent tests of what is written)."""
    for before in reconstructions:
        flat = reconstruction(
            before.building_id,
            list(before.rings),
            before.eave_height_m or 5.0,
            np.zeros(sum(map(len, before.rings))),
        )
        building = Building(
            before.building_id,
            "",
            before.origin_xy_m,
            before.rings,
            np.zeros((0, 3)),
            np.zeros(0, np.uint8),
            before.ground_z_m,
        )
        simpler = [] if flat is None else [flat]
        (after,) = with_valid_solids([before], [building], lambda row, simpler=simpler: simpler)
        if not after.has_mesh:
            yield before, after, []
            continue
        (codes,) = solid_rules.codes_of_text(written([after])).values()
        yield before, after, codes


def written(reconstructions: Iterable[Reconstruction]) -> str:
    """Buildings with a mesh as CityJSON text sequences."""
    meshes = [(each.building_id, each.placed_mesh) for each in reconstructions]
    solids = [cityjson.Solid(name, mesh.vertex_m, surfaces_to_write(mesh)[0]) for name, mesh in meshes]
    return "\n".join(cityjson.lines(solids, cityjson.Metadata(2154)))

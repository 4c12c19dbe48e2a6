"""Solids as the product makes them, on given outlines and without points: one roof, parts side by side, boxes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely
import solid_rules

from p2wss import skeleton
from p2wss.config import Scenes
from p2wss.data import reasons
from p2wss.data.building import Building, Reconstruction
from p2wss.fit.mesh.parametric import kernel_angles
from p2wss.fit.mesh.union import is_sound, union
from p2wss.fit.parts.cutting import side_of_cut
from p2wss.fit.parts.parts import main_frame
from p2wss.fit.roof.fitter import FittedRoof
from p2wss.fit.roof.work import Polygon
from p2wss.formats import cityjson
from p2wss.mesh import Mesh
from p2wss.mesh.repair import surfaces_to_write
from p2wss.reconstruct.valid import with_valid_solids
from p2wss.scenes.roofs import ANGLES_DEG, FootprintEdges, draw_angles
from p2wss.skeleton.types import Polygons

Rings = list[np.ndarray]
REGIMES = ("realistic", "uniform", "any")
MIN_EAVE_M, MAX_ROOF_M = 1.0, 12.0


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
    return _reconstruction(name, rings, eave_m, angle_deg, Mesh.of_kernel(meshes, 0))


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
    return Reconstruction(
        name, "", "fit", reasons.OK, *place, rings, eave_m, angle_deg, None, mesh, num_parts
    )


def with_parts(
    name: str, rings: Rings, seed: int, num_boxes: int, is_hard: bool = False
) -> Reconstruction | None:
    """A building of up to four parts, whose walls stand on random cuts along the axes of the outline, and boxes on its
    roof; None where they have no closed union.

    is_hard: eaves and boxes are nearly but not quite level, cuts nearly reach corners, and boxes end on walls, cuts and
    corners or millimetres beside them.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    rotation = main_frame(rings)
    pieces = [[ring @ rotation for ring in rings]]
    for _ in range(int(rng.integers(1, 4))):
        k = int(rng.integers(len(pieces)))
        pieces[k : k + 1] = _cut(pieces[k], rng, is_hard)
    parts = [_roof(piece, rng) for piece in pieces]
    boxes = [box for box in (_box(pieces, rng, is_hard) for _ in range(num_boxes)) if box is not None]
    if is_hard:
        eave_z_m = parts[0].eave_z_m
        parts = [replace(part, eave_z_m=eave_z_m + _nearly(rng)) for part in parts]
        boxes = [
            replace(box, eave_z_m=box.eave_z_m if rng.random() < 0.5 else eave_z_m + _nearly(rng))
            for box in boxes
        ]
    mesh = union([*parts, *boxes], MIN_EAVE_M, MAX_ROOF_M) if boxes else None
    if mesh is None or not is_sound(mesh):
        mesh = union(parts, MIN_EAVE_M, MAX_ROOF_M)
    if mesh is None:
        return None
    flat = np.zeros(sum(map(len, rings)))
    return _reconstruction(name, rings, 5.0, flat, mesh.turned(rotation.T), len(parts))


def _nearly(rng: np.random.Generator) -> float:
    """Zero, or a difference of millimetres to centimetres."""
    return float(rng.choice([0.0, 0.0, 5e-4, 2e-3, 8e-3, 0.03, 0.3, 2.0]) * rng.choice([-1, 1]))


def _cut(rings: Rings, rng: np.random.Generator, is_hard: bool) -> list[Rings]:
    xy_m, offset = np.concatenate(rings), np.cumsum([0, *map(len, rings)])
    axis = int(rng.integers(2))
    low, high = xy_m[:, axis].min(), xy_m[:, axis].max()
    position = float(low + rng.uniform(0.2, 0.8) * (high - low))
    if is_hard and rng.random() < 0.5:
        position = float(rng.choice(xy_m[:, axis])) + _nearly(rng)
    sides = []
    for is_high in (False, True):
        vertex_m, ring_offset = side_of_cut(Polygon(xy_m, offset), axis, position, is_high)
        if len(vertex_m) < 3:
            return [rings]
        side = [vertex_m[a:b] for a, b in pairwise(ring_offset)]
        shape = shapely.Polygon(side[0], side[1:])
        # the limits of the product's own cuts
        if not shape.is_valid or shape.area < 2 or shapely.minimum_clearance(shape) < 0.05:
            return [rings]
        sides.append(side)
    return sides


def _roof(rings: Rings, rng: np.random.Generator) -> FittedRoof:
    num = sum(map(len, rings))
    angle_deg = rng.choice([0.0, 90.0, *rng.uniform(5, 75, 4)], num)
    return FittedRoof(rings, angle_deg, float(rng.uniform(2.5, 9)), 0.0, 10)


def _box(pieces: list[Rings], rng: np.random.Generator, is_hard: bool) -> FittedRoof | None:
    """A flat box on the roof, some of them up to the walls."""
    rings = pieces[int(rng.integers(len(pieces)))]
    polygon = shapely.Polygon(rings[0], rings[1:])
    x0, y0, x1, y1 = polygon.bounds
    x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
    if is_hard:
        corner = rng.choice(np.concatenate([ring for piece in pieces for ring in piece]))
        x, y = corner + np.array([_nearly(rng), _nearly(rng)])
    shape = shapely.box(x, y, x + rng.uniform(0.8, 4), y + rng.uniform(0.8, 4)).intersection(polygon)
    if not isinstance(shape, shapely.Polygon) or shape.interiors or shape.area < 0.5:
        return None
    ring = shapely.get_coordinates(shapely.orient_polygons(shape.simplify(0.01)))[:-1]
    return FittedRoof([ring], np.zeros(len(ring)), float(rng.uniform(4, 14)), 0.0, 10)


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
        (after,) = with_valid_solids([before], [building], lambda row, invalid, simpler=simpler: simpler)
        if not after.has_mesh:
            yield before, after, []
            continue
        mesh = after.placed_mesh
        solid = cityjson.Solid(after.building_id, mesh.vertex_m, surfaces_to_write(mesh)[0])
        (codes,) = solid_rules.codes_of_text(
            "\n".join(cityjson.lines([solid], cityjson.Metadata(2154)))
        ).values()
        yield before, after, codes

"""Skins that end on the terrain: together with it one closed surface, and nothing below ground."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from skin_solids import Solid, gable, solid, volume

from p2wss.data.terrain import Terrain
from p2wss.formats.meshes import TERRAIN
from p2wss.mesh import Mesh
from p2wss.reconstruction.skin import Skin, skins, terrain_mesh
from p2wss.reconstruction.skin.block_skins import cut, wedges
from p2wss.skeleton.types import FaceKind

X, Y = 652000.0, 6861000.0


def block(height_m: np.ndarray, cell_m: float = 1.0, tolerance_m: float = 0.2) -> Mesh:
    """Terrain from (X, Y), its rows running south."""
    rows, columns = height_m.shape
    raster = Terrain(height_m.astype(np.float32), X, Y + rows * cell_m, cell_m)
    bounds = (X + cell_m, Y + cell_m, X + (columns - 1) * cell_m, Y + (rows - 1) * cell_m)
    return terrain_mesh.block(terrain_mesh.window(raster, bounds), tolerance_m, lowest_m=-20).mesh


def placed(solids: list[Solid], z_m: float = -10.0) -> list[Solid]:
    """The solids at (X + 20, Y + 20) with floors at ``z_m``."""
    result = []
    for each in solids:
        mesh = each.mesh.translated([X + 20, Y + 20, 0])
        mesh.vertex_m[np.unique(mesh.triangle[mesh.kind == FaceKind.GROUND]), 2] = z_m
        result.append(Solid(each.building_id, mesh))
    return result


def together(
    skin_list: list[Skin], terrain: Mesh, origin_m: np.ndarray | tuple[float, float, float] = (X, Y, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """All vertices and triangles in local coordinates, checked: equal places joined, they are closed."""
    meshes = [(skin.mesh.vertex_m, skin.mesh.triangle) for skin in skin_list] + [
        (terrain.vertex_m, terrain.triangle)
    ]
    first = np.cumsum([0, *(len(vertex) for vertex, _ in meshes)])
    place, index = np.unique(np.concatenate([vertex for vertex, _ in meshes]), axis=0, return_inverse=True)
    triangle = index.reshape(-1)[np.concatenate([t + f for (_, t), f in zip(meshes, first, strict=False)])]
    start, end = triangle.ravel(), np.roll(triangle, -1, axis=1).ravel()
    assert (start != end).all()
    forward, back = np.sort(start * len(place) + end), np.sort(end * len(place) + start)
    assert np.array_equal(forward, back)
    return place - np.asarray(origin_m), triangle


def united_volume(solids: list[Solid], terrain: Mesh) -> float:
    meshes = [(each.mesh.vertex_m, each.mesh.triangle) for each in solids] + [
        (terrain.vertex_m, terrain.triangle)
    ]
    bodies = [
        manifold3d.Manifold(manifold3d.Mesh64(vertex - [X, Y, 0], triangle.astype(np.uint64)))
        for vertex, triangle in meshes
    ]
    assert all(body.status() == manifold3d.Error.NoError for body in bodies)
    return manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add).volume()


@given(
    roughness=st.floats(0, 0.6),
    slope=st.floats(-0.1, 0.1),
    seed=st.integers(0, 2**31),
    turn_deg=st.floats(0, 90),
    tolerance_m=st.floats(0.05, 0.5),
)
@settings(max_examples=12, deadline=None)
def test_with_the_terrain_it_is_one_closed_surface(
    roughness: float, slope: float, seed: int, turn_deg: float, tolerance_m: float
) -> None:
    """A row, a house around a courtyard and one that touches the row in a corner alone, on rough land."""
    draw = np.random.default_rng(seed)
    height = np.add.outer(np.arange(90) * slope, np.arange(90) * slope / 2) + draw.normal(
        0, roughness, (90, 90)
    )
    terrain = block(height, tolerance_m=tolerance_m)
    ring = shapely.box(0, 20, 16, 34) - shapely.box(5, 25, 11, 29)
    turned = [
        shapely.affinity.rotate(shape, turn_deg, origin=(10, 12))
        for shape in (shapely.box(0, 0, 8, 10), shapely.box(8, 0, 15, 10), ring, shapely.box(15, 10, 20, 15))
    ]
    solids = placed(
        [solid(f"{k}", shape, 22 + k, 0 if k == 2 else 30) for k, shape in enumerate(turned)], -12
    )
    closed = skins(dict(solids), max_lowering_m=np.inf)
    assert [len(skin.building_ids) for skin in closed] == [2, 1, 1]
    standing, ground = cut(closed, terrain)
    assert all((skin.mesh.kind != FaceKind.GROUND).all() for skin in standing)
    assert (ground.kind == TERRAIN).all() and len(ground.kind) == len(ground.triangle) == len(ground.label)
    place, triangle = together(standing, ground)
    assert volume(place, triangle) == pytest.approx(united_volume(solids, terrain), rel=1e-6)
    for skin in standing:
        assert skin.mesh.vertex_m[:, 2].min() > height.min() - 1
    # in the courtyard there is land, in the house none
    corner = ground.vertex_m[ground.triangle] - [X + 20, Y + 20, 0]
    top = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2] > 1e-9
    faces, houses = shapely.polygons(corner[top][:, :, :2]), shapely.union_all(turned)
    land = shapely.union_all(faces[shapely.intersects(faces, houses.convex_hull)], grid_size=1e-6)
    assert land.intersection(houses).area < 0.02 * houses.length
    yard = shapely.Polygon(turned[2].interiors[0])
    assert land.intersection(yard).area == pytest.approx(yard.area, rel=1e-3)


def test_walls_end_at_the_foot_of_the_slope() -> None:
    terrain = block(np.tile(np.arange(80) * 0.1, (80, 1)))
    standing, ground = cut(skins(dict(placed([solid("a", shapely.box(0.3, 0.3, 10.3, 8.3), 20)]))), terrain)
    (house,) = standing
    assert house.building_ids == ("a",) and set(house.mesh.kind.tolist()) == {FaceKind.WALL, FaceKind.FLAT}
    local = house.mesh.vertex_m - [X + 20, Y + 20, 0]
    foot = local[local[:, 2] < 9]
    # cell centres are half a metre from the border
    assert foot[:, 2] == pytest.approx((foot[:, 0] + 20 - 0.5) * 0.1, abs=1e-5)
    assert len(np.unique(ground.vertex_m, axis=0)) == len(ground.vertex_m)
    edges = wedges(house)
    assert (edges.end_m[:, :, 2].max(axis=1) == 20).all() and len(edges.face) == 8


def test_a_house_in_a_slope_ends_there() -> None:
    """The roof of the first house is partly below the terrain, all of the second is."""
    terrain = block(np.tile(np.arange(80) * 0.3, (80, 1)))
    solids = placed([solid("a", shapely.box(0, 0, 20, 8), 8), gable("b", (20, 20, 28, 30), 5, 40)])
    standing, ground = cut(skins(dict(solids)), terrain)
    roof = standing[0].mesh.vertex_m[:, 2] == 8
    assert roof.any() and standing[0].mesh.vertex_m[:, 2].min() > 5
    assert len(standing[1].mesh.triangle) == 0
    together(standing[:1], ground)


def test_without_skins_the_terrain_stays() -> None:
    terrain = block(np.zeros((50, 50)))
    standing, ground = cut([], terrain)
    assert standing == [] and volume(ground.vertex_m, ground.triangle) == pytest.approx(
        volume(terrain.vertex_m, terrain.triangle)
    )

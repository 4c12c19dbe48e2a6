"""The block of terrain: closed, within its tolerance, and without a gap to the buildings."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trimesh.ray.ray_pyembree import RayMeshIntersector

from p2wss import skeleton
from p2wss.config import Reconstruct
from p2wss.data.terrain import Terrain
from p2wss.formats.meshes import TERRAIN, Body
from p2wss.mesh import Mesh
from p2wss.reconstruction.outputs import exports
from p2wss.reconstruction.skin import terrain_mesh
from p2wss.skeleton.types import Polygons
from p2wss.storage.messages import InputError

X, Y = 652000.0, 6861000.0


def terrain(height_m: np.ndarray, cell_m: float = 1.0) -> Terrain:
    """Terrain whose south-west corner is at (X, Y)."""
    return Terrain(height_m.astype(np.float32), X, Y + len(height_m) * cell_m, cell_m)


def checked(body: Body) -> trimesh.Trimesh:
    """The mesh in local coordinates, once checked: closed, outwards, no triangle without area."""
    mesh = body.mesh
    local = trimesh.Trimesh(mesh.vertex_m - [X, Y, 0], mesh.triangle, process=False)
    assert local.is_watertight and local.is_winding_consistent and local.volume > 0
    assert local.area_faces.min() > 1e-6 and (mesh.kind == TERRAIN).all()
    return local


@settings(max_examples=20, deadline=None)
@example(shape=(37, 37), cell_m=5.0, roughness=0.0, tolerance_m=0.0546875, seed=0)
@given(
    shape=st.tuples(st.integers(4, 40), st.integers(4, 40)),
    cell_m=st.sampled_from([0.5, 1.0, 5.0]),
    roughness=st.floats(0, 3),
    tolerance_m=st.floats(0.05, 1),
    seed=st.integers(0, 2**31),
)
def test_every_cell_is_within_the_tolerance(
    shape: tuple[int, int], cell_m: float, roughness: float, tolerance_m: float, seed: int
) -> None:
    draw = np.random.default_rng(seed)
    rows, columns = shape
    height = np.add.outer(np.sin(np.arange(rows) / 5), np.arange(columns) / 9)
    height = (height + draw.normal(0, roughness, shape)).astype(np.float32)
    bounds = (X + cell_m, Y + cell_m, X + (columns - 1) * cell_m, Y + (rows - 1) * cell_m)
    mesh = terrain_mesh.block(
        terrain_mesh.window(terrain(height, cell_m), bounds), tolerance_m, lowest_m=-50.0
    )
    local = checked(mesh)
    assert local.bounds[0, 2] < -50 and local.bounds[0, 2] < height.min()
    assert local.bounds[:, 0] == pytest.approx([cell_m / 2, (columns - 0.5) * cell_m])
    # the oracle: rays from above, slightly inside the border and beside edges, where Embree may miss both triangles
    x, y = (np.arange(columns) + 0.5) * cell_m, (rows - np.arange(rows) - 0.5) * cell_m
    xy = np.stack(np.meshgrid(x + 1.3e-4, y + 0.7e-4), axis=-1).reshape(-1, 2)
    xy = np.clip(xy, local.bounds[0, :2] + 1e-4, local.bounds[1, :2] - 1e-4)
    above = np.column_stack([xy, np.full(len(xy), 60.0)])
    down = np.tile([0.0, 0.0, -1.0], (len(xy), 1))
    hit, ray, _ = RayMeshIntersector(local).intersects_location(above, down, multiple_hits=False)
    assert len(np.unique(ray)) == len(xy)
    assert np.abs(hit[:, 2] - height.ravel()[ray]).max() <= tolerance_m + 0.01


def test_flat_land_needs_few_triangles_and_gaps_take_the_nearest_height() -> None:
    height = np.full((50, 60), 12.0)
    height[:, 30:] = np.nan
    mesh = terrain_mesh.block(terrain_mesh.window(terrain(height), (X - 20, Y + 5, X + 50, Y + 45)), 0.1)
    local = checked(mesh)
    assert len(mesh.mesh.triangle) == 14
    assert local.bounds[:, 2] == pytest.approx([10, 12])
    # also beyond the raster
    assert local.bounds[0, 0] <= -20 and local.bounds[1, 0] >= 50


def test_a_coarser_grid_of_a_large_terrain_is_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    height, bounds = np.add.outer(np.arange(60.0), np.zeros(60)), (X + 5, Y + 5, X + 55, Y + 55)
    body = terrain_mesh.block(terrain_mesh.window(terrain(height, 0.5), bounds), 0.1)
    assert body.attributes == {"spacing_m": 0.5}
    assert not caplog.text
    monkeypatch.setattr(terrain_mesh, "_MAX_CELLS", 1500)
    body = terrain_mesh.block(terrain_mesh.window(terrain(height, 0.5), bounds), 0.1)
    assert body.attributes == {"spacing_m": 1.5}
    assert "more than 1500 cells: its mesh has heights every 1.5 m, not every 0.5 m" in caplog.text


def test_terrain_without_any_height_is_refused() -> None:
    with pytest.raises(InputError, match="no height"):
        terrain_mesh.window(terrain(np.full((20, 20), np.nan)), (X, Y, X + 10, Y + 10))
    with pytest.raises(InputError, match="no height"):
        terrain_mesh.window(terrain(np.zeros((20, 20))), (X + 900, Y, X + 910, Y + 10))


def test_a_building_where_the_terrain_has_no_heights_reaches_into_its_block() -> None:
    height = np.full((60, 60), 20.0)
    height[20:40, 20:40] = np.nan
    meshes = skeleton.build(
        Polygons.from_rings([[np.array([[0, 0], [10, 0], [10, 8], [0, 8]], float)]]),
        np.array([35.0, 90, 35, 90]),
        np.array([5.0]),
    )
    house = Body.of_building("h", Mesh.of_kernel(meshes, 0).translated(np.array([X + 25, Y + 26, 23.0])))
    (lowered,), block = exports.with_terrain([house], terrain(height), Reconstruct(terrain_margin_m=12))
    assert block.mesh.vertex_m[:, 2].max() == 20
    assert lowered.mesh.vertex_m[:, 2].min() < 20 and house.mesh.vertex_m[:, 2].min() == 23


@pytest.mark.parametrize("has_gaps", [False, True])
def test_no_gap_under_a_building_and_no_ray_that_sees_an_inside(has_gaps: bool) -> None:
    """Houses with level ground faces on a slope, each at the height of the ground at its upper end. has_gaps: whether
    the terrain has no heights under them, as some national ones."""
    height = np.add.outer(np.zeros(60), 20 + 0.3 * np.arange(60)) + 0.2 * np.sin(np.arange(60))
    for x, y in ((15, 20), (35, 30)) if has_gaps else ():
        height[60 - y - 11 : 60 - y + 3, x - 3 : x + 13] = np.nan
    land = terrain(height)
    meshes = skeleton.build(
        Polygons.from_rings([[np.array([[0, 0], [10, 0], [10, 8], [0, 8]], float)]] * 2),
        np.array([35.0, 90, 35, 90] * 2),
        np.array([5.0, 5.0]),
    )
    places, houses = ((15, 20), (35, 30)), []
    for i, (x, y) in enumerate(places):
        position = np.array([X + x, Y + y, 20 + 0.3 * (x + 10)])
        houses.append(Body.of_building(f"h{i}", Mesh.of_kernel(meshes, i).translated(position)))
    window = terrain_mesh.window(land, (X + 5, Y + 10, X + 55, Y + 48))
    block = terrain_mesh.block(window, 0.1, 20.0)
    lowered = terrain_mesh.lowered_into(houses, window, 0.1)
    draw = np.random.default_rng(0)

    ground = RayMeshIntersector(checked(block))
    for (x, y), before, after in zip(places, houses, lowered, strict=True):
        above = np.column_stack([draw.uniform([x, y], [x + 10, y + 8], (500, 2)), np.full(500, 90.0)])
        hit = ground.intersects_location(above, np.tile([0, 0, -1.0], (500, 1)), multiple_hits=False)[0]
        assert len(hit) == 500
        assert hit[:, 2].min() < before.mesh.vertex_m[:, 2].min() - 1
        assert hit[:, 2].min() > after.mesh.vertex_m[:, 2].min()
        moved = (before.mesh.vertex_m != after.mesh.vertex_m).any(axis=1)
        assert moved.sum() == 4 and (after.mesh.vertex_m[~moved] == before.mesh.vertex_m[~moved]).all()

    scene = trimesh.util.concatenate(
        [
            trimesh.Trimesh(m.mesh.vertex_m - [X, Y, 0], m.mesh.triangle, process=False)
            for m in (*lowered, block)
        ]
    )
    assert scene.is_watertight and scene.is_winding_consistent
    away = draw.normal(size=(20_000, 3))
    away /= np.linalg.norm(away, axis=1)[:, None]
    aim = draw.uniform([15, 20, 20], [45, 38, 40], (20_000, 3))
    hit = RayMeshIntersector(scene).intersects_first(aim + 200 * away, -away)
    is_hit = hit >= 0
    assert is_hit.mean() > 0.8
    assert (scene.face_normals[hit[is_hit]] * -away[is_hit]).sum(axis=1).max() < 1e-3


def test_a_coarse_terrain_leaves_no_gap_under_a_building_either() -> None:
    height = 50 + 3 * np.outer(np.cos(np.arange(200) / 22), np.sin(np.arange(200) / 30))
    land, boxes = terrain(height, 0.5), [(x, y) for x in range(20, 80, 9) for y in range(20, 80, 9)]
    meshes = skeleton.build(
        Polygons.from_rings(
            [[np.array([[x, y], [x + 8, y], [x + 8, y + 8], [x, y + 8]], float)] for x, y in boxes]
        ),
        np.full(4 * len(boxes), 45.0),
        np.full(len(boxes), 5.0),
    )
    houses = [
        Body.of_building(f"h{i}", Mesh.of_kernel(meshes, i).translated(np.array([X, Y, 50.0])))
        for i in range(len(boxes))
    ]
    tolerance_m = 3.0
    window = terrain_mesh.window(land, (X + 10, Y + 10, X + 95, Y + 95))
    block = terrain_mesh.block(window, tolerance_m, 50.0)
    ground = RayMeshIntersector(checked(block))
    lowered = terrain_mesh.lowered_into(houses, window, tolerance_m)
    for (x, y), house in zip(boxes, lowered, strict=True):
        above = np.column_stack(
            [np.random.default_rng(0).uniform([x, y], [x + 8, y + 8], (50, 2)), np.full(50, 90.0)]
        )
        hit = ground.intersects_location(above, np.tile([0, 0, -1.0], (50, 1)), multiple_hits=False)[0]
        floor_z = house.mesh.vertex_m[:, 2].min()
        assert block.mesh.vertex_m[:, 2].min() < floor_z < hit[:, 2].min()

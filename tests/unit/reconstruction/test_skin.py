"""Skins of blocks: closed, as large as the union, without walls between buildings, every face with its building."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from kernel_unions import union
from skin_solids import Solid, assert_closed, gable, solid, united, volume

from p2wss.fit.parametric import FittedRoof
from p2wss.mesh import Mesh
from p2wss.reconstruction.skin import Skin, sheets, skins, triangulated
from p2wss.reconstruction.skin.block_skins import wedges
from p2wss.reconstruction.skin.common_roofs import MAX_STEP_M
from p2wss.reconstruction.skin.party_walls import without_party_walls
from p2wss.reconstruction.skin.solids import MAX_LOWERING_M, faces_of
from p2wss.skeleton.types import FaceKind


def exact(solids: list[Solid], merged_m3: float = 0.0) -> list[Skin]:
    """Skins, checked against the union. merged_m3: how much the volume may change as corners that
    are millimetres apart become one."""
    result = skins(dict(solids))
    assert [skin.failure for skin in result] == [None] * len(result)
    for skin in result:
        assert_closed(skin)
    assert sorted(name for skin in result for name in skin.building_ids) == sorted(
        s.building_id for s in solids
    )
    total = sum(volume(skin.mesh.vertex_m, skin.mesh.triangle) for skin in result)
    assert total == pytest.approx(united(solids).volume(), rel=1e-6, abs=merged_m3)
    return result


def wall_area(skin: Skin, building: str | None = None) -> float:
    corner = skin.mesh.vertex_m[skin.mesh.triangle]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    mask = skin.mesh.kind == FaceKind.WALL
    if building is not None:
        mask &= skin.building == skin.building_ids.index(building)
    return float(area[mask].sum())


def test_a_building_alone_keeps_its_triangles() -> None:
    alone = gable("a", (0, 0, 8, 10), 6, 40)
    (skin,) = exact([alone])
    assert np.array_equal(
        np.sort(skin.mesh.vertex_m[skin.mesh.triangle].reshape(-1, 9), axis=0),
        np.sort(alone.mesh.vertex_m[alone.mesh.triangle].reshape(-1, 9), axis=0),
    )


def test_a_step_between_roofs_belongs_to_the_higher_building() -> None:
    low, high = solid("low", shapely.box(0, 0, 8, 10), 4), solid("high", shapely.box(8, 0, 15, 10), 7)
    (skin,) = exact([high, low])
    assert skin.building_ids == ("high", "low")
    # three walls of the low house; of the high one three and the step of 3 m by 10 m
    assert wall_area(skin, "low") == pytest.approx((8 + 10 + 8) * 4)
    assert wall_area(skin, "high") == pytest.approx((7 + 10 + 7) * 7 + 3 * 10)
    # nothing of the plane between them remains below the step
    corner = skin.mesh.vertex_m[skin.mesh.triangle]
    between = (np.abs(corner[:, :, 0] - 8) < 1e-9).all(axis=1)
    assert corner[between][:, :, 2].min() == 4
    assert len(skin.mesh.vertex_m) == 14


def test_roofs_of_one_height_have_no_wall_between_them() -> None:
    boxes = [shapely.box(6 * k, 0, 6 * k + 6, 9) for k in range(4)]
    row = [solid(str(k), box, 5) for k, box in enumerate(boxes)]
    (skin,) = exact(row)
    assert wall_area(skin) == pytest.approx((24 + 9) * 2 * 5)
    assert len(skin.mesh.triangle) <= 0.9 * sum(len(house.mesh.triangle) for house in row)
    # an edge between coplanar roofs is no wedge: two at every ridge-less house front, four corners, and the floor's
    assert len(wedges(skin).face) == 2 * (4 + 4) + 4 + 4


@pytest.mark.parametrize("ground_z_m", [0.0, 0.7, -2.0])
def test_a_row_against_a_long_house(ground_z_m: float) -> None:
    """T-junctions: corners of the row lie within the long wall; some houses are higher than it, and floors differ."""
    solids = [solid("long", shapely.box(0, 0, 30, 8), 6)]
    solids += [
        solid(f"row{k}", shapely.box(2 + 5 * k, 8, 7 + 5 * k, 20), height, 0.0, ground_z_m)
        for k, height in enumerate((4.0, 7.5, 5.0, 6.0, 9.0))
    ]
    assert len(exact(solids)) == 1


def test_floors_of_neighbours_become_level() -> None:
    floors = [0.0, 0.2, 0.45, 0.6, 3.0]
    solids = [solid(str(k), shapely.box(6 * k, 0, 6 * k + 6, 9), 5, 0.0, z) for k, z in enumerate(floors)]
    (skin,) = skins(dict(solids))
    assert_closed(skin)
    ground = skin.mesh.kind == FaceKind.GROUND
    level = {
        name: set(skin.mesh.vertex_m[skin.mesh.triangle[ground & (skin.building == k)], 2].ravel().tolist())
        for k, name in enumerate(skin.building_ids)
    }
    assert all(len(heights) == 1 for heights in level.values())
    lowered = np.array(floors) - [level[str(k)].pop() for k in range(5)]
    assert (lowered >= 0).all() and lowered.max() <= MAX_LOWERING_M and lowered[4] == 0
    assert (lowered > 0).sum() == 2


def test_gables_of_different_pitch_cross() -> None:
    first, second = gable("a", (0, 0, 8, 10), 5, 45), gable("b", (0, 10, 8, 18), 6, 30)
    (skin,) = exact([first, second])
    # a's ridge is higher, b's eaves are: two crossings, and a wall on either side of each
    along = skin.mesh.vertex_m[np.abs(skin.mesh.vertex_m[:, 1] - 10) < 1e-9]
    crossing_z = 5 + (1 / (1 - np.tan(np.pi / 6)))
    assert (np.abs(along[:, 2] - crossing_z) < 1e-9).sum() == 2
    assert (
        wall_area(skin) < wall_area(skins(dict([first]))[0]) + wall_area(skins(dict([second]))[0]) - 2 * 8 * 5
    )


def test_ridges_that_nearly_meet() -> None:
    """Two gables 1 mm behind or before each other, whose ridges are 0 to 9 mm beside, and up to 12 mm above, each
    other, without planes that move."""
    offsets_m = np.linspace(0, 0.009, 4), [9.999, 10.001], np.linspace(-0.012, 0.012, 17)
    for beside_m, front_m, above_m in itertools.product(*offsets_m):
        houses = [
            gable("a", (0, 0, 8, 10), 5, 45),
            gable("b", (beside_m, front_m, 8 + beside_m, 18), 5 + above_m, 45),
        ]
        point, faces = without_party_walls(*faces_of([house.mesh for house in houses]))
        mesh = sheets(triangulated(point, faces))
        assert_closed(Skin(("a", "b"), mesh, mesh.label))
        assert mesh.volume_m3 == pytest.approx(united(houses).volume(), rel=1e-3)


def test_a_house_in_the_corner_of_another() -> None:
    """At the corner there are two floors and two roofs alone, each on one plane, and no wall."""
    corner = shapely.box(5, 5, 12, 11)
    (skin,) = exact([solid("l", shapely.box(0, 0, 12, 11) - corner, 6), solid("in", corner, 6)])
    at_corner = (np.abs(skin.mesh.vertex_m[:, :2] - 5) < 1e-9).all(axis=1)
    assert sorted(skin.mesh.vertex_m[at_corner, 2]) == [0, 6]
    roof = skin.mesh.area_m2[(skin.mesh.kind == FaceKind.FLAT) & (skin.building == 0)]
    assert roof.sum() == pytest.approx(corner.area)


@pytest.mark.parametrize("pitch_deg", [40.0, 40.4])
def test_roofs_a_little_apart_meet_and_stay_planar(pitch_deg: float) -> None:
    """Eaves 3 cm apart, ridges up to 8 cm: without planes that move there is a band between the roofs."""
    houses = [gable("a", (0, 0, 8, 6), 5, 40), gable("b", (0, 6, 8, 12), 5.03, pitch_deg)]
    (skin,) = skins(dict(houses))
    assert_closed(skin)
    assert trimesh.triangles.angles(skin.mesh.corner_m).min() > np.radians(10) and skin.mesh.edge_m.min() > 3
    assert volume(skin.mesh.vertex_m, skin.mesh.triangle) == pytest.approx(united(houses).volume(), rel=1e-3)
    for label in np.unique(skin.mesh.label):
        corner_m = skin.mesh.corner_m[skin.mesh.label == label].reshape(-1, 3)
        corner_m = corner_m - corner_m.mean(axis=0)
        assert np.abs(corner_m @ np.linalg.svd(corner_m)[2][2]).max() < 1e-5
    assert np.abs(skin.mesh.doubled_m2[skin.mesh.kind == FaceKind.WALL, 2]).max() < 1e-9


def test_walls_between_roofs_meet_if_they_are_a_little_apart() -> None:
    """Both houses have a low and a high part; where these meet differs by 4 cm. The ends of the houses stay."""
    plans = [((0, 0, 5, 6), 4), ((5, 0, 9, 6), 7)], [((0, 6, 5.04, 12), 4), ((5.04, 6, 9, 12), 7)]
    houses = [
        Solid(
            name,
            union(
                [
                    FittedRoof([shapely.get_coordinates(shapely.box(*box))[:-1]], np.full(4, 90.0), z, 0.0)
                    for box, z in parts
                ]
            ),
        )
        for name, parts in zip("ab", plans, strict=True)
    ]
    (skin,) = skins(dict(houses))
    assert_closed(skin)
    assert skin.mesh.edge_m.min() > 2 and wall_area(skin) == pytest.approx(42 * 4 + 32 * 3, abs=0.2)
    x_m = skin.mesh.vertex_m[:, 0]
    assert set(x_m[(x_m < 4) | (x_m > 6)].round(9).tolist()) == {0, 9}
    assert x_m[(x_m > 4) & (x_m < 6)] == pytest.approx(5.02, abs=0.021)


def test_heights_that_differ_by_a_tenth_of_a_metre_are_one() -> None:
    """Maps and tables round heights to tenths; a centimetre more is noise."""
    (skin,) = skins(dict(solid(str(k), shapely.box(8 * k, 0, 8 * k + 8, 10), 5 + 0.11 * k) for k in range(2)))
    assert_closed(skin)
    assert skin.mesh.vertex_m[:, 2] == pytest.approx(
        np.where(skin.mesh.vertex_m[:, 2] > 1, 5.055, 0), abs=1e-4
    )


def test_an_inner_wall_turns_to_the_front_of_a_neighbour() -> None:
    """It goes on from a front and ends 15 mm beside the neighbour's: at the other end, it cannot shift."""
    high = solid("high", shapely.Polygon([(0, -3), (6, -3), (6, 5), (0, 4.985)]), 8.0)
    low = solid("low", shapely.Polygon([(0, 4.985), (6, 5), (9, 5.0075), (9, 12), (0, 12)]), 4.0)
    house = skins(dict([high, low]))[0].mesh
    # the wall beside the neighbour is one
    house = replace(house, label=np.where((house.corner_m[..., 0] == 0).all(axis=1), 100, house.label))
    (skin,) = skins({"A": house.part(slice(None)), "B": solid("B", shapely.box(-8, 5, 0, 12), 6.0).mesh})
    assert_closed(skin)
    assert skin.mesh.edge_m.min() > 1


def test_some_steps_stay_where_vertices_would_move_too_far() -> None:
    steps = [solid(str(k), shapely.box(8 * k, 0, 8 * k + 8, 10), 5 + 0.09 * k) for k in range(5)]
    (skin,) = skins(dict(steps))
    assert_closed(skin)
    roof_m = skin.mesh.vertex_m[np.unique(skin.mesh.triangle[skin.mesh.kind == FaceKind.FLAT])]
    levels_m = np.unique(roof_m[:, 2].round(3))
    assert 1 < len(levels_m) < 5
    assert np.abs(roof_m[:, 2] - 5 - 0.09 * (roof_m[:, 0] // 8)).max() < MAX_STEP_M + 0.09


def test_houses_around_a_courtyard() -> None:
    ring = shapely.box(0, 0, 20, 20) - shapely.box(6, 6, 14, 14)
    pieces = [
        ring & shapely.box(*box) for box in ((0, 0, 20, 6), (0, 6, 6, 20), (6, 14, 20, 20), (14, 6, 20, 14))
    ]
    solids = [solid(str(k), piece, 5 + k, 0) for k, piece in enumerate(pieces)]
    (skin,) = exact(solids)
    # one handle
    assert len(skin.mesh.vertex_m) - len(skin.mesh.triangle) // 2 == 0


def test_a_garage_within_a_wall() -> None:
    """Neither its sides nor its top or floor reach the edges of the wall it stands at: a hole in that wall."""
    house, garage = (
        solid("house", shapely.box(0, 0, 12, 9), 7),
        solid("shed", shapely.box(3, 9, 7, 12), 3, 0, 0.8),
    )
    (skin,) = exact([house, garage])
    assert wall_area(skin, "house") == pytest.approx(2 * (12 + 9) * 7 - 4 * 3)


def test_walls_shift_to_the_corner_beside_them() -> None:
    """A house stands 2 cm behind the front of its neighbour: both have one front, between its corners."""
    solids = [solid("a", shapely.box(0, 0, 6, 8), 4), solid("b", shapely.box(6, 0.02, 12, 9), 6)]
    (skin,) = exact(solids, merged_m3=1.0)
    assert skin.mesh.edge_m.min() > 0.9
    front_m = skin.mesh.vertex_m[skin.mesh.vertex_m[:, 1] < 1]
    assert np.abs(front_m[:, 1] - front_m[:, 0] * 0.02 / 12).max() < 1e-6


def row(turn_deg: float, rise_m: float = 0.02) -> dict[str, Mesh]:
    """Five houses with gables at their party walls, whose eaves and slopes differ a little, on a line that turns by
    ``turn_deg`` at each of them."""
    line, bearing = [np.zeros(2)], 0.0
    for _ in range(5):
        line.append(line[-1] + 6 * np.array([np.cos(bearing), np.sin(bearing)]))
        bearing += np.radians(turn_deg)
    depth = np.array([0.0, 10.0])
    return {
        str(k): solid(
            str(k),
            shapely.Polygon([line[k], line[k + 1], line[k + 1] + depth, line[k] + depth]),
            5 + rise_m * (k % 2),
            [30 + 0.1 * (k % 3), 90, 30, 90],
        ).mesh
        for k in range(5)
    }


def test_roofs_and_fronts_of_a_row_are_one_plane_each() -> None:
    solids = row(turn_deg=0.1)
    (skin,) = skins(solids)
    assert_closed(skin)
    mesh = skin.mesh
    is_roof = mesh.kind == FaceKind.ROOF
    is_front = (mesh.kind == FaceKind.WALL) & (mesh.doubled_m2[:, 1] < -0.9 * 2 * mesh.area_m2)
    for faces in (is_front, is_roof & (mesh.doubled_m2[:, 1] < 0), is_roof & (mesh.doubled_m2[:, 1] > 0)):
        normal = mesh.doubled_m2[faces] / np.linalg.norm(mesh.doubled_m2[faces], axis=1)[:, None]
        assert np.degrees(np.arccos(np.clip(normal @ normal.T, -1, 1))).max() < 0.05
    # the corners at both ends of the front stay
    plan_m = np.concatenate([each.vertex_m[:, :2] for each in (solids["0"], solids["4"])])
    for corner in (plan_m[plan_m.sum(axis=1).argmin()], plan_m[(plan_m @ [1, -1]).argmax()]):
        assert np.hypot(*(mesh.vertex_m[:, :2] - corner).T).min() < 1e-6


def test_a_curved_row_and_different_roofs_keep_their_planes() -> None:
    (skin,) = skins(row(turn_deg=2.5, rise_m=0.5))
    assert_closed(skin)
    mesh = skin.mesh
    front = mesh.doubled_m2[(mesh.kind == FaceKind.WALL) & (mesh.doubled_m2[:, 1] < 0)]
    bearings = np.unique(np.degrees(np.arctan2(front[:, 0], -front[:, 1])).round(1))
    assert len(bearings[np.abs(bearings) < 45]) == 5
    eaves = np.unique(mesh.vertex_m[mesh.vertex_m[:, 2] > 4, 2].round(2))
    assert len(eaves) >= 4


def test_buildings_that_touch_in_a_corner_stay_apart() -> None:
    solids = [solid("a", shapely.box(0, 0, 5, 5), 4), solid("b", shapely.box(5, 5, 9, 9), 6)]
    assert [skin.building_ids for skin in exact(solids)] == [("a",), ("b",)]


@pytest.mark.parametrize("heights", list(itertools.permutations((3.0, 4.0, 5.0, 6.0))))
def test_four_houses_around_a_point(heights: tuple[float, ...]) -> None:
    """Where two opposite ones are the higher, their sheets touch in an upright edge, each with vertices of its own."""
    corners = ((0, 0), (5, 0), (5, 5), (0, 5))
    solids = [
        solid(str(k), shapely.box(x, y, x + 5, y + 5), z)
        for k, ((x, y), z) in enumerate(zip(corners, heights, strict=True))
    ]
    (skin,) = exact(solids)
    centre = skin.mesh.vertex_m[(np.abs(skin.mesh.vertex_m[:, :2] - 5) < 1e-9).all(axis=1)]
    opposite = min(max(heights[0], heights[2]), max(heights[1], heights[3])) < max(
        min(heights[0], heights[2]), min(heights[1], heights[3])
    )
    assert (len(np.unique(centre, axis=0)) < len(centre)) == opposite


def test_houses_that_touch_in_an_edge_between_others() -> None:
    """Two opposite houses are joined below the edge by a low one, and above it by one whose floor is as high: the edge
    has a point within, so that the walls at it have edges of their own."""
    places = {"sw": (0, 0, 0.0, 6.0), "ne": (5, 5, 0.0, 6.0), "se": (5, 0, 0.0, 2.0), "nw": (0, 5, 4.0, 4.0)}
    (skin,) = exact(
        [
            solid(name, shapely.box(x, y, x + 5, y + 5), height_m, ground_z_m=floor_m)
            for name, (x, y, floor_m, height_m) in places.items()
        ]
    )
    assert (skin.mesh.vertex_m == [5, 5, 3]).all(axis=1).sum() == 2


@given(
    heights=st.lists(st.sampled_from([3.0, 3.06, 3.3, 4.0, 5.0]), min_size=12, max_size=12),
    roofs=st.lists(st.sampled_from([0, 30, 45, 90]), min_size=12, max_size=12),
    cuts=st.lists(st.floats(0.3, 2.7), min_size=6, max_size=6),
    turn_deg=st.floats(0, 90),
    kept=st.sets(st.integers(0, 11), min_size=2),
)
# eaves 2.1 mm above the foot of a roof's edge, and one that crosses a steep edge 2 mm beside an upright one
@example(
    heights=[3.0, 3.3, 3.06, 3.3, 3.0, 3.0, 3.0, 3.06, 3.06, 3.06, 3.0, 3.0],
    roofs=[0, 0, 30, 0, 0, 0, 0, 0, 0, 30, 30, 0],
    cuts=[1.75, 1.875, 0.5, 2.0625, 1.5, 1.5],
    turn_deg=0.0,
    kept=set(range(11)),
)
@example(
    heights=[3.06, 3.0, 3.06, 3.3, 3.0, 3.06, 3.0, 3.3, 3.0, 3.3, 3.0, 3.3],
    roofs=[70, 60, 60, 60, 60, 75, 75, 75, 70, 70, 60, 70],
    cuts=[
        1.6218470950528148,
        1.6900001111980536,
        0.9536434696008662,
        1.8593920377248854,
        1.4097888761355437,
        2.337433428930168,
    ],
    turn_deg=0.0,
    kept=set(range(12)) - {3},
)
@settings(max_examples=60, deadline=None)
def test_any_coverage(
    heights: list[float], roofs: list[int], cuts: list[float], turn_deg: float, kept: set[int]
) -> None:
    """Rows of houses with T-junctions between the rows, turned by any angle, some left out."""
    place = np.array([652000.0, 6861000.0])
    turn = np.radians(turn_deg)
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    solids = []
    for row in range(2):
        ends = np.cumsum([0.0, *(4 + cut for cut in np.roll(cuts, 3 * row)[:6])])
        # centimetres: nearer corners become one
        ends = np.round(ends / ends[-1] * 34, 2)
        for k in range(6):
            number = 6 * row + k
            if number in kept:
                corner = np.array(
                    [
                        (ends[k], 8 * row),
                        (ends[k + 1], 8 * row),
                        (ends[k + 1], 8 * row + 8),
                        (ends[k], 8 * row + 8),
                    ]
                )
                angles = (
                    [roofs[number], 90, roofs[number], 90]
                    if number % 2
                    else [90, roofs[number], 90, roofs[number]]
                )
                polygon = shapely.Polygon(corner @ turned + place)
                solids.append(solid(f"{number:02}", polygon, heights[number], angles))
    # roofs that end within centimetres of the height of a neighbour move by half of the step at most
    exact(solids, merged_m3=MAX_STEP_M / 2 * 34 * 16)


def test_overlapping_buildings_stay_apart_with_the_reason() -> None:
    """Two walls of the long house's side lie in one place: the houses overlap."""
    solids = [
        solid("long", shapely.box(0, 0, 20, 8), 5),
        solid("a", shapely.box(2, 8, 9, 15), 6),
        solid("b", shapely.box(7, 8, 14, 15), 7),
    ]
    result = skins(dict(solids))
    assert [skin.building_ids for skin in result] == [("a",), ("b",), ("long",)]
    assert all(skin.failure and "overlap" in skin.failure for skin in result)
    for skin in result:
        assert_closed(skin)


def test_order_of_the_buildings_has_no_effect() -> None:
    solids = [solid(f"r{k}", shapely.box(5 * k, 0, 5 * k + 5, 9), 5 + 0.04 * k, 30) for k in range(5)]
    (first,), (second,) = skins(dict(solids)), skins(dict(solids[::-1]))
    assert np.array_equal(first.mesh.vertex_m, second.mesh.vertex_m)
    assert np.array_equal(first.mesh.triangle, second.mesh.triangle)


def test_wedges_of_a_box_and_of_a_step() -> None:
    low, high = solid("low", shapely.box(0, 0, 8, 10), 4), solid("high", shapely.box(8, 0, 15, 10), 7)
    edges = wedges(skins(dict([low]))[0])
    assert len(edges.face) == 12 and edges.opening_angle_deg == pytest.approx(np.full(12, 90))
    length = np.linalg.norm(edges.end_m[:, 1] - edges.end_m[:, 0], axis=1)
    assert sorted(length.round(6)) == [4] * 4 + [8] * 4 + [10] * 4
    (skin,) = skins(dict([low, high]))
    edges = wedges(skin)
    ends = {tuple(sorted(map(tuple, np.round(end, 6).tolist()))) for end in edges.end_m}
    # the top of the step is a wedge; its foot, where the low roof ends, is concave
    assert ((8.0, 0.0, 7.0), (8.0, 10.0, 7.0)) in ends and ((8.0, 0.0, 4.0), (8.0, 10.0, 4.0)) not in ends
    assert ((8.0, 0.0, 4.0), (8.0, 0.0, 7.0)) in ends and ((8.0, 0.0, 0.0), (8.0, 0.0, 4.0)) not in ends
    assert edges.opening_angle_deg == pytest.approx(np.full(len(ends), 90))


def test_wedge_of_a_ridge() -> None:
    edges = wedges(skins(dict([gable("a", (0, 0, 8, 10), 5, 40)]))[0])
    ridge = (edges.end_m[:, :, 2] > 8).all(axis=1)
    assert edges.opening_angle_deg[ridge] == pytest.approx([100]) and len(edges.face) == 4 + 4 + 2 + 4 + 1


def test_wedges_are_the_convex_edges_of_the_mesh_whatever_its_faces_should_be() -> None:
    """A corner of the roof is 30 cm too high: the fold within its face is an edge of the mesh."""
    (skin,) = skins(dict([gable("a", (0, 0, 8, 10), 5, 40)]))
    vertex_m = skin.mesh.vertex_m.copy()
    vertex_m[np.flatnonzero(np.isclose(vertex_m[:, 2], 5))[0], 2] += 0.3
    bent = replace(skin, mesh=skin.mesh.moved(vertex_m))
    mesh = trimesh.Trimesh(bent.mesh.vertex_m, bent.mesh.triangle, process=False)
    angle_deg = np.degrees(mesh.face_adjacency_angles)
    is_convex = mesh.face_adjacency_convex & (angle_deg > 1)
    expected = {
        tuple(sorted(edge)): 180 - angle
        for edge, angle in zip(
            mesh.face_adjacency_edges[is_convex].tolist(), angle_deg[is_convex], strict=True
        )
    }
    edges = wedges(bent)
    number = {tuple(place): i for i, place in enumerate(vertex_m.round(6).tolist())}
    found = {
        tuple(sorted(number[tuple(end)] for end in ends)): angle
        for ends, angle in zip(edges.end_m.round(6).tolist(), edges.opening_angle_deg, strict=True)
    }
    assert found == pytest.approx(expected, abs=0.01) and len(edges.face) == len(expected)
    assert any(165 < angle < 179 for angle in expected.values())


def test_a_narrow_gap_between_houses_has_no_wedge_inside() -> None:
    """Two walls that part at one degree: the edge where they part is concave, however narrow the gap."""
    second = shapely.Polygon([(8, 0), (14, 0), (14, 10), (8 + 10 * np.tan(np.radians(1)), 10)])
    third = shapely.Polygon([(0, -6), (14, -6), (14, 0), (8, 0), (0, 0)])
    solids = [solid("a", shapely.box(0, 0, 8, 10), 6), solid("b", second, 6), solid("c", third, 4, 0)]
    (skin,) = exact(solids)
    edges = wedges(skin)
    assert ((edges.opening_angle_deg > 60) & (edges.opening_angle_deg < 120)).all()
    at_gap = (np.abs(edges.end_m[:, :, :2] - [8, 0]) < 1e-6).all(axis=(1, 2))
    # above the low house its neighbours have a corner each, below its roof there is none
    assert at_gap.sum() == 2 and (edges.end_m[at_gap][:, :, 2] >= 4).all()

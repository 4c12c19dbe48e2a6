"""Clutter: where it stands, how it is tagged, and that the points on the labelled building stay as they are."""

import numpy as np
import pytest
import shapely
from toy_scene import TILE, TILE_SIZE_M, ground_m, house, houses, table, terrain

from p2wss.config import Clutter, Scans
from p2wss.scans import scan as scans
from p2wss.scans.surface import ClutterKind, las_classes

NOTHING = dict.fromkeys(Clutter.model_fields, 0) | {"eave_overhang_m": (0, 0)}
EXACT = {
    "divergence_mrad": (0, 0),
    "range_noise_m": (0, 0),
    "pointing_noise_m": (0, 0),
    "strip_offset_xy_m": 0,
    "strip_offset_z_m": 0,
    "base_loss": (0, 0),
    "dark_roof_share": 0,
    "min_intensity": 0,
    "density_per_m2": 25,
    "density_spread": 0,
}


def survey(rows, **shares):
    settings = Scans(preset="hd", clutter=NOTHING | shares, **EXACT)
    return scans.simulate(table(rows), terrain(), TILE, TILE_SIZE_M, settings)


def places(scan, rows, kind):
    """Of the points on clutter of one kind: building, depth inside its footprint, height above its ground,
    height above its roof, and its eave height; float64 each."""
    x, y, z = (scan.points.xyz_mm / 1000 + scan.origin_m).T
    index = np.flatnonzero(scan.points.face == 4 * kind)
    number = scan.points.building[index]
    facts = np.array(
        [
            [
                *(r["origin_x_m"], r["origin_y_m"], *r["footprint_xy_m"][4:6], r["terrain_z_m"]),
                *(r["eave_height_m"], np.tan(np.radians(r["angle_deg"][1]))),
            ]
            for r in rows
        ]
    )[number]
    u, v = x[index] - facts[:, 0], y[index] - facts[:, 1]
    across = np.minimum(u, facts[:, 2] - u)
    depth = np.minimum(across, np.minimum(v, facts[:, 3] - v))
    above = z[index] - facts[:, 4]
    return number, depth, above, above - facts[:, 5] - across * facts[:, 6], facts[:, 5]


def test_points_on_the_labelled_building_keep_their_places_and_tags():
    rows = houses()
    scan = survey(
        rows,
        dormer_share=1,
        chimney_share=1,
        annex_share=1,
        trees_per_building=1,
        eave_overhang_share=1,
        eave_overhang_m=(0.2, 0.4),
    )
    assert min(scan.facts["clutter"].values()) > 3
    x, y, z = (scan.points.xyz_mm / 1000 + scan.origin_m).T
    kind, edge = scan.points.face & 3, (scan.points.face >> 2) - 1
    ground = scan.points.face == -1
    np.testing.assert_allclose(z[ground], ground_m(x[ground], y[ground]), atol=0.002)
    assert (scan.points.building[ground] == -1).all()
    for number, row in enumerate(rows):
        index = np.flatnonzero((scan.points.building == number) & (kind == 2))
        u, width = x[index] - row["origin_x_m"], row["footprint_xy_m"][4]
        across = np.where(edge[index] == 1, width - u, u)
        roof = row["terrain_z_m"] + row["eave_height_m"] + across * np.tan(np.radians(row["angle_deg"][1]))
        np.testing.assert_allclose(z[index], roof, atol=0.003)
    facts = scan.facts
    names = ("ground", "wall", "roof", "tree", "other")
    assert sum(facts[f"num_{name}_points"] for name in names) == facts["num_points"]
    assert facts["num_other_points"] > 1000
    classes = las_classes(scan.points.face)
    assert set(classes[scan.points.face == 4 * ClutterKind.TREE]) == {5}
    assert set(classes[(scan.points.face >= 0) & (scan.points.face != 4 * ClutterKind.TREE)]) == {6}
    assert set(classes[ground]) == {2}


@pytest.mark.parametrize(
    ("kind", "share", "above_roof_m"),
    [
        (ClutterKind.DORMER, "dormer_share", (0.0, 1.4 + 1.1)),
        (ClutterKind.CHIMNEY, "chimney_share", (0.0, 1.6 + 0.5)),
    ],
)
def test_objects_on_roofs_stand_on_the_roof_of_their_building(kind, share, above_roof_m):
    rows = houses()
    scan = survey(rows, **{share: 1})
    number, depth, _, above_roof, _ = places(scan, rows, kind)
    assert len(np.unique(number)) > 0.5 * len({r for r in scan.points.building if r >= 0})
    assert depth.min() > -0.002
    assert above_roof.min() > above_roof_m[0] - 0.003
    assert above_roof.max() < above_roof_m[1] + 0.003


def test_annexes_stand_beside_their_building_and_in_no_other():
    rows = houses()
    scan = survey(rows, annex_share=1)
    number, depth, above, _, eave = places(scan, rows, ClutterKind.ANNEX)
    assert len(np.unique(number)) > 5
    assert depth.max() < 0 and depth.min() > -6 * np.sqrt(2)
    assert (above < eave - 0.29).all() and above.max() < 3.201
    is_annex = scan.points.face == 4 * ClutterKind.ANNEX
    x, y = (scan.points.xyz_mm[is_annex, :2] / 1000 + scan.origin_m[:2]).T
    for number, row in enumerate(rows):
        corners = row["footprint_xy_m"].reshape(-1, 2) + np.array([row["origin_x_m"], row["origin_y_m"]])
        others = scan.points.building[is_annex] != number
        shape = shapely.Polygon(corners).buffer(-0.06)
        assert not shapely.contains_xy(shape, x[others], y[others]).any()


def test_trees_hide_a_part_of_what_is_below():
    rows = houses()
    bare, scan = survey(rows), survey(rows, trees_per_building=1.5)
    tree = scan.points.face == 4 * ClutterKind.TREE
    assert (scan.points.building[tree] == -1).all()
    x, y, z = (scan.points.xyz_mm / 1000 + scan.origin_m).T
    above = z[tree] - ground_m(x[tree], y[tree])
    assert above.min() > -0.5 and above.max() < 15.5
    # under and between the leaves there is still ground, but less of it
    cell = np.stack([x, y], axis=1) // 0.5
    under = {tuple(c) for c in cell[tree]}
    both = sum(tuple(c) in under for c in cell[scan.points.face == -1])
    bare_cells = (bare.points.xyz_mm[:, :2] / 1000 + bare.origin_m[:2]) // 0.5
    before = sum(tuple(c) in under for c in bare_cells[bare.points.face == -1])
    assert 0.05 < both / before < 0.8
    roofs = [((s.points.building >= 0) & (s.points.face & 3 == 2)).sum() for s in (bare, scan)]
    assert roofs[1] < 0.995 * roofs[0]  # some crowns are over roofs


def on_house(scan, row, number):
    """Of the points of one house: kind of face, distance inwards from the footprint edge of the face, height
    above the roof."""
    index = np.flatnonzero(scan.points.building == number)
    x, y, z = (scan.points.xyz_mm[index] / 1000 + scan.origin_m).T
    u, v = x - row["origin_x_m"], y - row["origin_y_m"]
    width, length = row["footprint_xy_m"][4:6]
    inwards = np.stack([v, width - u, length - v, u])
    face = scan.points.face[index]
    across = np.minimum(u, width - u)
    roof = row["terrain_z_m"] + row["eave_height_m"] + across * np.tan(np.radians(row["angle_deg"][1]))
    return face & 3, inwards[np.clip((face >> 2) - 1, 0, 3), np.arange(len(index))], z - roof


def test_walls_are_set_back_under_the_eaves_and_roofs_stay():
    rows = houses()
    bare, scan = survey(rows), survey(rows, eave_overhang_share=1, eave_overhang_m=(0.4, 0.4))
    walls = [0, 0]
    for number, row in enumerate(rows):
        kind, inwards, above = on_house(scan, row, number)
        np.testing.assert_allclose(inwards[kind == 1], 0.4, atol=0.002)
        np.testing.assert_allclose(above[kind == 2], 0, atol=0.003)
        walls[0] += (on_house(bare, row, number)[0] == 1).sum()
        walls[1] += (kind == 1).sum()
    # eaves hide what is just below them: 0.4 m over the tangent of the scan angle
    assert 0.5 * walls[0] < walls[1] < 0.95 * walls[0]
    assert scan.facts["num_roof_points"] == bare.facts["num_roof_points"]


def test_a_wall_against_a_neighbour_stays():
    rows = [house(652_540, 6_861_950, 10, 12, 4, 35.0, "A"), house(652_550, 6_861_950, 9, 12, 9, 40.0, "B")]
    scan = survey(rows, eave_overhang_share=1, eave_overhang_m=(0.3, 0.3))
    is_wall = (scan.points.building == 1) & (scan.points.face & 3 == 1)
    x, y = (scan.points.xyz_mm[:, :2] / 1000 + scan.origin_m[:2]).T
    shared = is_wall & ((scan.points.face >> 2) - 1 == 3)
    assert shared.sum() > 10  # above the lower roof
    np.testing.assert_allclose(x[shared], 652_550, atol=0.002)
    north = is_wall & ((scan.points.face >> 2) - 1 == 2)
    np.testing.assert_allclose(y[north], 6_861_962 - 0.3, atol=0.002)


def test_a_building_has_the_same_clutter_whatever_stands_around_it():
    rows = [house(652_540, 6_861_950, 10, 12, 6, 35.0, "A"), house(652_580, 6_861_920, 9, 12, 5, 40.0, "B")]
    shares = dict.fromkeys(("dormer_share", "chimney_share", "annex_share"), 1) | {"trees_per_building": 1}
    together, alone = (survey(r, **shares).points for r in (rows, rows[1:]))
    # nothing else occludes either of the two, and the survey is that of the tile
    for kind in (ClutterKind.DORMER, ClutterKind.CHIMNEY, ClutterKind.ANNEX):
        a = together.xyz_mm[(together.face == 4 * kind) & (together.building == 1)]
        b = alone.xyz_mm[(alone.face == 4 * kind) & (alone.building == 0)]
        assert len(a) > 0
        np.testing.assert_array_equal(np.sort(a, axis=0).max(axis=0), np.sort(b, axis=0).max(axis=0))


@pytest.mark.parametrize("preset", ["none", "paper"])
def test_only_hd_has_clutter(preset):
    full = {"trees_per_building": 3, "chimney_share": 1}
    results = [
        scans.simulate(
            table(houses()), terrain(), TILE, TILE_SIZE_M, Scans(preset=preset, clutter=NOTHING | shares)
        )
        for shares in (full, {})
    ]
    assert results[0].facts["clutter"] == {}
    np.testing.assert_array_equal(results[0].points.xyz_mm, results[1].points.xyz_mm)

"""The samplers of roof angles: allowed values, plausible roofs, and closed meshes for all of them."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import shapely
import shapely.affinity

from p2wss import skeleton
from p2wss.config import RoofShares, Scenes
from p2wss.data import polygon_arrays
from p2wss.scenes.roofs import ANGLES_DEG, FootprintEdges, draw_angles

RECTANGLE = shapely.box(0, 0, 14, 8)
L_SHAPE = shapely.Polygon([(0, 0), (16, 0), (16, 8), (7, 8), (7, 18), (0, 18)])
T_SHAPE = shapely.Polygon([(0, 0), (20, 0), (20, 8), (14, 8), (14, 16), (7, 16), (7, 8), (0, 8)])
U_SHAPE = shapely.Polygon([(0, 0), (24, 0), (24, 18), (17, 18), (17, 8), (7, 8), (7, 18), (0, 18)])
COURTYARD = shapely.box(0, 0, 40, 36).difference(shapely.box(9, 9, 31, 27))
SHAPES = {"rectangle": RECTANGLE, "L": L_SHAPE, "T": T_SHAPE, "U": U_SHAPE, "courtyard": COURTYARD}


def only(roof_type: str) -> RoofShares:
    zero = dict.fromkeys(RoofShares.model_fields, 0.0)
    return RoofShares(**{**zero, roof_type: 1.0})


def edges_of(shape: shapely.Polygon, party: list[int] | None = None) -> FootprintEdges:
    polygons = polygon_arrays.to_polygons([shapely.orient_polygons(shape)])
    is_party = np.isin(np.arange(len(polygons.xy_m)), party or [])
    radius = shapely.maximum_inscribed_circle(shape).length
    return FootprintEdges.from_rings(polygons.rings(0), is_party, radius)


def draws(shape: shapely.Polygon, config: Scenes, number: int = 200, party: list[int] | None = None):
    results = [draw_angles(edges_of(shape, party), f"B{i}", config) for i in range(number)]
    return [name for name, _ in results], np.array([angle for _, angle in results])


def test_uniform_is_uniform() -> None:
    """All 28 values are equally frequent and edges are independent: a chi-square test with 27 degrees of freedom."""
    names, angles = draws(L_SHAPE, Scenes(sampler="uniform"), 1000)
    assert set(names) == {"uniform"}
    counts = Counter(angles.ravel().astype(int).tolist())
    assert set(counts) == set(ANGLES_DEG.tolist())
    expected = angles.size / 28
    assert sum((count - expected) ** 2 / expected for count in counts.values()) < 55
    assert abs(np.corrcoef(angles[:, 0], angles[:, 1])[0, 1]) < 0.1


def test_uniform_kinds_are_a_third_each() -> None:
    _, angles = draws(L_SHAPE, Scenes(sampler="uniform-kinds"), 1000)
    shares = [(angles == 0).mean(), (angles == 90).mean(), ((angles >= 20) & (angles <= 45)).mean()]
    assert shares == pytest.approx([1 / 3] * 3, abs=0.02)


def test_angles_depend_only_on_seed_and_building() -> None:
    first = draw_angles(edges_of(L_SHAPE), "B7", Scenes())
    again = draw_angles(edges_of(L_SHAPE), "B7", Scenes())
    assert first[0] == again[0] and np.array_equal(first[1], again[1])
    different = [draw_angles(edges_of(L_SHAPE), "B7", Scenes(seed=s))[1].tolist() for s in range(20)]
    assert len(set(map(tuple, different))) > 10


def test_roof_types_have_their_shares() -> None:
    names, _ = draws(RECTANGLE, Scenes(), 1500)
    shares = RoofShares()
    counts = Counter(names)
    for name, share in shares.model_dump().items():
        assert counts[name.replace("_", "-")] / 1500 == pytest.approx(share, abs=0.04)


def test_gables_of_a_rectangle_are_on_its_short_sides() -> None:
    _, angles = draws(RECTANGLE, Scenes(roof_shares=only("gable")))
    lengths = np.hypot(
        *np.diff(np.vstack([edges_of(RECTANGLE).xy_m, edges_of(RECTANGLE).xy_m[:1]]), axis=0).T
    )
    assert (angles[:, lengths < 10] == 90).all()
    assert ((angles[:, lengths > 10] >= 20) & (angles[:, lengths > 10] <= 45)).all()
    same = angles[:, lengths > 10][:, 0] == angles[:, lengths > 10][:, 1]
    assert 0.8 < same.mean() < 0.99


def test_gables_of_wings() -> None:
    """Gables are at the ends of the wings of an L, a T and a U, and never beside a reflex corner."""
    for shape, number in [(L_SHAPE, 2), (T_SHAPE, 3), (U_SHAPE, 2)]:
        names, angles = draws(shape, Scenes(roof_shares=only("gable")), 30)
        assert set(names) == {"gable"}
        assert ((angles == 90).sum(axis=1) == number).all()


def test_a_step_in_a_wall_is_not_a_wing() -> None:
    """A rectangle with a small step near a corner has its gables on the short sides."""
    stepped = shapely.Polygon([(0, 0), (12, 0), (12, 9), (5, 9), (5, 10), (0, 10)])
    xy = edges_of(stepped).xy_m
    short = [i for i in range(6) if xy[i, 0] == xy[(i + 1) % 6, 0] and abs(xy[i, 1] - xy[(i + 1) % 6, 1]) > 5]
    _, angles = draws(stepped, Scenes(roof_shares=only("gable")), 20)
    assert (angles[:, short] == 90).all() and ((angles == 90).sum(axis=1) == 2).all()


def test_hip_half_hip_flat_shed() -> None:
    for roof_type, vertical, flat in [("hip", 0, 0), ("half_hip", 1, 0), ("flat", 0, 4), ("shed", 3, 0)]:
        names, angles = draws(RECTANGLE, Scenes(roof_shares=only(roof_type)), 50)
        assert set(names) == {roof_type.replace("_", "-")}
        assert ((angles == 90).sum(axis=1) == vertical).all()
        assert ((angles == 0).sum(axis=1) == flat).all()


def test_party_walls_are_vertical_and_ridges_follow_the_street() -> None:
    """A row house deeper than wide: without its neighbours its gables would face the street."""
    house = shapely.box(0, 0, 6, 10)
    xy = edges_of(house).xy_m
    walls = [i for i in range(4) if xy[i, 0] == xy[(i + 1) % 4, 0]]
    for roof_type in ("gable", "hip", "half_hip"):
        names, angles = draws(house, Scenes(roof_shares=only(roof_type)), 20, party=walls)
        assert set(names) == {"gable"}
        assert (angles[:, walls] == 90).all()
        assert (np.delete(angles, walls, axis=1) < 46).all()
    names, angles = draws(house, Scenes(roof_shares=only("hip")), 20, party=walls[:1])
    assert set(names) == {"half-hip"}, "the free end of a row"
    assert (angles[:, walls[0]] == 90).all() and (angles[:, walls[1]] < 46).all()
    names, angles = draws(house, Scenes(roof_shares=only("gable")), 20, party=walls[:1])
    assert (angles[:, walls] == 90).all()


def test_party_walls_leave_a_shed_roof_or_a_flat_one() -> None:
    """A gable over three party walls is a shed roof, too high for its depth, and over four no roof at all."""
    yard = shapely.box(0, 0, 8, 12)
    for roof_type in ("gable", "hip", "half_hip", "shed"):
        names, angles = draws(yard, Scenes(roof_shares=only(roof_type)), 50, party=[0, 1, 2])
        assert set(names) == {"shed"} and (angles[:, :3] == 90).all()
        depth_m = 8 if edges_of(yard).xy_m[3, 0] == edges_of(yard).xy_m[0, 0] else 12
        assert (depth_m * np.tan(np.radians(angles[:, 3]))).max() <= 7
    for roof_type in ("gable", "hip", "half_hip", "shed", "mixed"):
        names, angles = draws(yard, Scenes(roof_shares=only(roof_type)), 20, party=[0, 1, 2, 3])
        assert set(names) == {"flat"} and not angles.any()
    _, angles = draws(yard, Scenes(roof_shares=only("mixed")), 300, party=[0, 2])
    assert (angles[:, [0, 2]] == 90).all()


def test_courtyards_have_eaves() -> None:
    names, angles = draws(COURTYARD, Scenes(roof_shares=only("gable")), 40)
    assert set(names) == {"hip"}
    assert ((angles >= 20) & (angles <= 45)).all()


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_no_vertical_edge_beside_a_reflex_corner(shape: shapely.Polygon) -> None:
    """Neither from the roof type nor from a party wall."""
    ring = edges_of(shape)
    edge = ring.xy_m[ring.next_edge] - ring.xy_m
    before = np.argsort(ring.next_edge)
    reflex = edge[before][:, 0] * edge[:, 1] - edge[before][:, 1] * edge[:, 0] < 0
    beside = reflex | reflex[ring.next_edge]
    _, angles = draws(shape, Scenes(), 200, party=list(range(len(edge))))
    assert (angles[:, beside] != 90).all()


def test_wide_buildings_get_flat_or_low_pitched_roofs() -> None:
    hall = shapely.box(0, 0, 60, 30)
    names, angles = draws(hall, Scenes(max_rise_m=7, roof_shares=only("gable")), 50)
    sloped = angles[(angles > 0) & (angles < 90)]
    assert set(names) == {"gable"} and sloped.max() <= np.degrees(np.arctan(7 / 15))
    names, _ = draws(shapely.box(0, 0, 90, 80), Scenes(max_rise_m=7, roof_shares=only("gable")), 5)
    assert set(names) == {"flat"}


@pytest.mark.parametrize("sampler", ["realistic", "uniform", "uniform-kinds"])
def test_all_drawn_angles_give_a_closed_mesh(sampler: str) -> None:
    shapes, angles = [], []
    for turn in (0.0, 23.0):
        for shape in SHAPES.values():
            turned = shapely.orient_polygons(shapely.affinity.rotate(shape, turn))
            for i in range(25):
                shapes.append(turned)
                angles.append(draw_angles(edges_of(turned), f"B{i}", Scenes(sampler=sampler))[1])  # type: ignore[arg-type]
    meshes = skeleton.build(
        polygon_arrays.to_polygons(shapes),
        np.concatenate(angles),
        np.full(len(shapes), 5.0),
        base_height_m=np.zeros(len(shapes)),
        max_roof_height_m=12,
    )
    assert (meshes.status == skeleton.Status.OK).all()

"""Events that are almost simultaneous: symmetric shapes with noise of any size get a sound roof of the right slopes."""

import json

import numpy as np
import pytest
import shapely
from places import ROOT, SHARED

import p2wss
from p2wss.skeleton import Polygons, build

HOUSE = SHARED / "data" / "cases" / "roof_near_tie" / "osm_way_119261398.json"
PLUS = np.array(
    [
        [5, 0],
        [10, 0],
        [10, 5],
        [15, 5],
        [15, 10],
        [10, 10],
        [10, 15],
        [5, 15],
        [5, 10],
        [0, 10],
        [0, 5],
        [5, 5],
    ],
    float,
)
L_SHAPE = np.array([[0, 0], [16, 0], [16, 8], [8, 8], [8, 16], [0, 16]], float)


def test_symmetric_shapes_with_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import near_ties

    draws = near_ties.draw(480, 3)
    assert dict(enumerate(why for why in near_ties.failures(draws) if why)) == {}


@pytest.mark.skipif(not HOUSE.is_file(), reason="no real data beside the checkout")
@pytest.mark.parametrize("move_m", [0.0, 7e6])
def test_a_house_at_all_angles_has_one_volume(move_m: float) -> None:
    ring = np.array(json.loads(HOUSE.read_text())["ring"])
    turns = np.linspace(0.0, np.pi, 17)
    turned = [ring[:-1] @ np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) + move_m for t in turns]
    volumes = [p2wss.roof(ring, 3.0, 45.0).volume for ring in turned]
    np.testing.assert_allclose(volumes, volumes[0], rtol=1e-6)


@pytest.mark.parametrize("ring", [L_SHAPE, PLUS])
@pytest.mark.parametrize("noise_m", [1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4])
def test_noise_of_every_size(ring: np.ndarray, noise_m: float) -> None:
    rng = np.random.default_rng(0)
    polygons = Polygons.from_rings([[ring + noise_m * rng.normal(size=ring.shape)] for _ in range(60)])
    meshes = build(polygons, np.full(len(polygons.xy_m), 30.0), np.full(60, 3.0))
    assert (meshes.status == 0).all()


@pytest.mark.parametrize("inner_deg", [45.0, 60.0, 90.0])
def test_a_courtyard_whose_wavefront_touches_the_outer_one(inner_deg: float) -> None:
    """The flat inner edge sweeps a triangle whose tip ends on the outer edge."""
    turn = np.pi / 3.0 * np.arange(6)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    turned = [np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) for t in np.linspace(0, np.pi, 20)]
    polygons = Polygons.from_rings([[10.0 * circle @ each, 5.0 * circle[::-1] @ each] for each in turned])
    angle_deg = np.array([0.0, *[30.0] * 5, 0.0, *[inner_deg] * 5])
    meshes = build(polygons, np.tile(angle_deg, 20), np.full(20, 5.0))
    assert (meshes.status == 0).all()


@pytest.mark.parametrize(
    ("seed", "number"),
    [
        (0, 29127),  # both sides of a sharp notch between walls, at one height
        (1, 57029),  # as above
        (2, 36436),  # a piece jumps past a vertex when it swallows a parallel one
        (6, 38695),  # an arc that rises along a wall past another node
    ],
)
def test_shapes_that_failed(seed: int, number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import near_ties

    first = number // 2400 * 2400
    draws = near_ties.draw(number + 1 - first, 1_000_003 * seed + first)
    ring, polygon = draws.polygons.ring_offset, draws.polygons.polygon_offset[-2:]
    rings = [draws.polygons.xy_m[ring[k] : ring[k + 1]] for k in range(*polygon)]
    angle_deg = draws.angle_deg[-sum(map(len, rings)) :]
    assert build(Polygons.from_rings([rings]), angle_deg, np.full(1, 5.0)).status.tolist() == [0]


def test_either_orientation_and_one_part() -> None:
    ring, angle_deg = [(0, 0), (20, 0), (20, 10), (0, 10)], [45, 90, 30, 90]
    expected = p2wss.roof(ring, 3, angle_deg)
    clockwise = p2wss.roof(ring[::-1], 3, [30, 90, 45, 90])
    assert clockwise.volume == pytest.approx(expected.volume)
    np.testing.assert_allclose(clockwise.bounds, expected.bounds)
    part = p2wss.roof(shapely.MultiPolygon([shapely.Polygon(ring)]), 3, angle_deg)
    assert part.volume == pytest.approx(expected.volume)
    court = shapely.Polygon(ring, [[(5, 3), (9, 3), (9, 7), (5, 7)]])
    backwards = shapely.Polygon(ring, [[(5, 3), (5, 7), (9, 7), (9, 3)]])
    assert p2wss.roof(court, 3, 45).volume == pytest.approx(p2wss.roof(backwards, 3, 45).volume)


@pytest.mark.parametrize(
    ("footprint", "angle_deg", "words"),
    [
        (
            shapely.MultiPolygon([shapely.box(0, 0, 8, 8), shapely.box(9, 0, 12, 2)]),
            45,
            "once for each polygon",
        ),
        ([(0, 0), (8, 8), (8, 0), (0, 6)], 45, "crosses itself"),
        ([(0, 0), (8, 0), (8, 8), (8, 8.0001)], 45, "shorter than a millimetre"),
        (shapely.box(0, 0, 8, 8), 3, "5 to 85 degrees"),
    ],
)
def test_a_refusal_says_what_to_do(footprint: object, angle_deg: float, words: str) -> None:
    with pytest.raises(p2wss.InputError, match=words):
        p2wss.roof(footprint, 3, angle_deg)

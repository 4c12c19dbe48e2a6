"""Sides of cuts through polygons, against shapely."""

import numpy as np
import pytest
import shapely

from p2wss.fit.linkage import linked_work
from p2wss.fit.parts.cutting import clearance_m, inherited_angles, is_sound, side_of_cut
from p2wss.fit.roof.fitter import flat_rings
from p2wss.fit.roof.work import Polygon

ELL = np.array([[0, 0], [4, 0], [4, 2], [2, 2], [2, 4], [0, 4.0]])
CUP = np.array([[0, 0], [4, 0], [4, 4], [3, 4], [3, 2], [1, 2], [1, 4], [0, 4.0]])
COURT = [np.array([[0, 0], [9, 0], [9, 9], [0, 9.0]]), np.array([[3, 3], [3, 6], [6, 6], [6, 3.0]])]


def shape(polygon: Polygon) -> shapely.Polygon:
    rings = np.split(polygon.xy_m, polygon.ring_offset[1:-1])
    return shapely.Polygon(rings[0], rings[1:])


def blocks(seed: int) -> list[np.ndarray]:
    """Rings of a random union of rectangles, counter-clockwise, courtyards clockwise."""
    rng = np.random.default_rng(seed)
    corner = rng.integers(0, 8, (6, 2))
    size = rng.integers(2, 7, (6, 2))
    shape = shapely.union_all([shapely.box(*c, *(c + s)) for c, s in zip(corner, size, strict=True)])
    largest = max(shapely.get_parts(shape), key=lambda part: part.area)
    turned = shapely.orient_polygons(largest.simplify(0), exterior_cw=False)
    return [np.array(ring.coords)[:-1] for ring in (turned.exterior, *turned.interiors)]


# seeds whose blocks do not touch themselves at a corner
CLEAN = [seed for seed in range(60) if len(np.unique(xy := np.concatenate(blocks(seed)), axis=0)) == len(xy)]


@pytest.mark.parametrize("seed", CLEAN)
def test_sides_are_those_of_shapely(seed: int) -> None:
    rings = blocks(seed)
    polygon = flat_rings(rings)
    whole, work = shape(polygon), linked_work(64, 8)
    rng = np.random.default_rng(seed)
    # through corners as well as between them
    for position in (*rng.uniform(0, 12, 3), *rng.integers(0, 12, 3).astype(float)):
        for axis in (0, 1):
            for is_high in (False, True):
                bounds = [-99.0, -99.0, 99.0, 99.0]
                bounds[axis if is_high else 2 + axis] = position
                expected = shapely.intersection(whole, shapely.box(*bounds))
                side = side_of_cut(polygon, axis, position, is_high)
                sound = is_sound(side, clearance_m(polygon, work.at), work.at)
                if isinstance(expected, shapely.Polygon) and 0 < expected.area < whole.area - 1e-9:
                    inner = not expected.buffer(-0.46, join_style="mitre").is_empty
                    clear = shapely.minimum_clearance(expected.simplify(0)) > 0.05
                    if expected.area > 2.01 and inner and clear:
                        assert sound
                if sound:
                    assert shapely.equals(shape(side).normalize(), expected.normalize()) or (
                        shape(side).symmetric_difference(expected).area < 1e-9
                    )


def test_a_side_in_two_pieces_is_not_sound() -> None:
    polygon = flat_rings([CUP])
    work = linked_work(32, 8)
    for position in (2.0, 2.5):
        above = side_of_cut(polygon, 1, position, True)
        assert not is_sound(above, 1.0, work.at)
    below, _ = side_of_cut(polygon, 1, 2.0, False)
    assert shapely.Polygon(below).area == 8


def test_a_cut_through_a_courtyard_opens_it() -> None:
    polygon = flat_rings(COURT)
    side_xy, side_offset = side_of_cut(polygon, 0, 4.0, False)
    assert len(side_offset) == 2 and shapely.Polygon(side_xy).area == pytest.approx(36 - 3)
    assert (side_xy[:, 0] == 4.0).sum() == 4
    side_xy, side_offset = side_of_cut(polygon, 0, 2.0, True)
    assert side_offset.tolist() == [0, 4, 8]


@pytest.mark.parametrize(
    ("position", "sound"),
    [(0.4, False), (0.92, True), (1.96, False), (2.0, True), (2.04, False), (3.5, False)],
)
def test_thin_and_touching_sides_are_refused(position: float, sound: bool) -> None:
    polygon = flat_rings([ELL])
    work = linked_work(32, 8)
    sides = [side_of_cut(polygon, 0, position, is_high) for is_high in (False, True)]
    assert all(is_sound(side, 1.0, work.at) for side in sides) == sound


def test_edges_inherit_angles_from_those_they_lie_on() -> None:
    polygon = flat_rings([ELL])
    angle_deg = np.array([10, 20, 30, 40, 50, 60.0])
    side = side_of_cut(polygon, 0, 3.0, True)
    inherited_deg = inherited_angles(polygon, angle_deg, side, 0, 3.0, 90.0)
    start = [(x, y) for x, y in side.xy_m.tolist()]
    assert dict(zip(start, inherited_deg.tolist(), strict=True)) == {
        (3, 0): 10, (4, 0): 20, (4, 2): 30, (3, 2): 90
    }  # fmt: skip

"""Boxes on a roof: detected where they are and only there, one closed solid with the roof, on by default."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from toy_roofs import sample

from p2wss.config import Reconstruct
from p2wss.data.building import Building, Reconstruction
from p2wss.fit.fitting import fit
from p2wss.fit.mesh.union import is_sound

WIDE_M, DEEP_M, EAVE_M = 14.0, 9.0, 5.0
HOUSE = np.array([[0, 0], [WIDE_M, 0], [WIDE_M, DEEP_M], [0, DEEP_M]])
TAN = np.tan(np.radians(40.0))
RIDGE_M = EAVE_M + TAN * DEEP_M / 2
# x from, x to, y from, y to, top: a box at the wall and one within the slope; both end in the roof
AT_WALL, WITHIN = (2.0, 5.0, 0.0, 3.0, 7.4), (8.0, 11.0, 1.2, 3.6, 7.9)


def roof_over(vertex_m: np.ndarray, triangle: np.ndarray, xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(height of the mesh's topmost face, z of its unit normal) over each position (m, 2); minus infinity and 1 outside
    the mesh."""
    corner = vertex_m[triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1)
    upward = normal[:, 2] > 1e-6 * np.maximum(length, 1e-9)
    height, slant = np.full(len(xy_m), -np.inf), np.ones(len(xy_m))
    for (a, b, c), n, size in zip(corner[upward], normal[upward], length[upward], strict=True):
        within = np.ones(len(xy_m), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            within &= (q[0] - p[0]) * (xy_m[:, 1] - p[1]) - (q[1] - p[1]) * (xy_m[:, 0] - p[0]) >= -1e-9
        z = a[2] - ((xy_m - a[:2]) @ n[:2]) / n[2]
        higher = within & (z > height)
        height[higher], slant[higher] = z[higher], n[2] / size
    return height, slant


def roof_z(xy_m: np.ndarray) -> np.ndarray:
    return EAVE_M + TAN * np.minimum(xy_m[:, 1], DEEP_M - xy_m[:, 1])


def house(*boxes: tuple[float, ...], num_points: int = 900) -> Building:
    point_m = sample([HOUSE], [40, 90, 40, 90], EAVE_M, num_points, 0.0)
    for x0, x1, y0, y1, top in boxes:
        x, y, z = point_m.T
        over = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        point_m[over, 2] = np.maximum(z[over], top)
    point_m[:, 2] += np.random.default_rng(3).normal(0, 0.03, len(point_m))
    return Building("a", "t", (0.0, 0.0), [HOUSE], point_m, np.full(len(point_m), 6), 0.0)


def fit_one(building: Building, dormers: bool) -> Reconstruction:
    (reconstruction,) = fit([building], Reconstruct(dormers=dormers, max_parts=1))
    return reconstruction


def volume(reconstruction: Reconstruction) -> float:
    return float(
        trimesh.Trimesh(reconstruction.mesh.vertex_m, reconstruction.mesh.triangle, process=False).volume
    )


def true_volume(*boxes: tuple[float, ...]) -> float:
    cell = 0.02
    x, y = np.meshgrid(np.arange(cell / 2, WIDE_M, cell), np.arange(cell / 2, DEEP_M, cell))
    xy_m = np.column_stack([x.ravel(), y.ravel()])
    z = roof_z(xy_m)
    for x0, x1, y0, y1, top in boxes:
        over = (xy_m[:, 0] > x0) & (xy_m[:, 0] < x1) & (xy_m[:, 1] > y0) & (xy_m[:, 1] < y1)
        z[over] = np.maximum(z[over], top)
    return float(z.sum() * cell**2)


def test_two_box_dormers_are_detected_and_the_mesh_is_closed() -> None:
    building = house(AT_WALL, WITHIN)
    reconstruction = fit_one(building, dormers=True)
    assert reconstruction.num_parts == 1 and reconstruction.mesh.is_closed
    assert volume(reconstruction) == pytest.approx(true_volume(AT_WALL, WITHIN), rel=0.01)
    assert volume(reconstruction) - volume(fit_one(house(), dormers=True)) == pytest.approx(
        true_volume(AT_WALL, WITHIN) - true_volume(), rel=0.25
    )
    for x0, x1, y0, _, top in (AT_WALL, WITHIN):
        # well within the box its top, half a metre beside it the slope
        middle = np.array([[(x0 + x1) / 2, y0 + 0.4]])
        beside = np.array([[x0 - 0.4, y0 + 0.4], [x1 + 0.4, y0 + 0.4]])
        height, _ = roof_over(
            reconstruction.mesh.vertex_m, reconstruction.mesh.triangle, np.vstack([middle, beside])
        )
        assert height[0] == pytest.approx(top, abs=0.08)
        assert height[1:] == pytest.approx(roof_z(beside), abs=0.12)
    # the box at the wall begins there, the other one does not
    near_wall = np.array([[3.5, 0.02], [9.5, 0.6]])
    height, _ = roof_over(reconstruction.mesh.vertex_m, reconstruction.mesh.triangle, near_wall)
    assert height[0] == pytest.approx(7.4, abs=0.08)
    assert height[1] == pytest.approx(roof_z(near_wall[1:])[0], abs=0.12)


def test_a_terrace_within_the_slope_is_a_recess() -> None:
    """The floor of the terrace lies below the roof; beyond it the roof stays, and the solid is closed."""
    building = house(num_points=1500)
    x, y = building.point_m[:, 0], building.point_m[:, 1]
    over = (x > 4) & (x < 8) & (y > 1) & (y < 4)
    building.point_m[over, 2] = EAVE_M
    reconstruction = fit_one(building, dormers=True)
    assert reconstruction.mesh.is_closed
    at = np.array([[6.0, 3.0], [6.0, 6.5], [3.4, 3.0], [8.6, 3.0]])
    height, _ = roof_over(reconstruction.mesh.vertex_m, reconstruction.mesh.triangle, at)
    assert height[0] == pytest.approx(EAVE_M, abs=0.1)
    assert height[1:] == pytest.approx(roof_z(at[1:]), abs=0.12)
    box = true_volume() - (4 * 3 * TAN * 2.5)
    assert volume(reconstruction) == pytest.approx(box, rel=0.02)


def test_a_clean_gable_and_a_chimney_get_no_box() -> None:
    chimney = (6.0, 6.5, 2.0, 2.6, 10.0)
    for building in (house(), house(chimney)):
        with_option, without = fit_one(building, dormers=True), fit_one(building, dormers=False)
        assert np.array_equal(with_option.mesh.triangle, without.mesh.triangle)
        assert with_option.mesh.vertex_m.tobytes() == without.mesh.vertex_m.tobytes()
    # the points do show the chimney
    assert (house(chimney).point_m[:, 2] > 9.5).any()


# x from, x to, y from, y to, top: on a slope, at the ridge, beside an eave and on the wall of the gable
ON_SLOPE, AT_RIDGE = (6.0, 6.5, 2.0, 2.6, 8.3), (10.0, 10.6, 4.2, 4.8, RIDGE_M + 0.9)
BESIDE_EAVE, ON_GABLE = (3.0, 3.5, 0.1, 0.7, 6.6), (13.5, 14.0, 6.0, 6.6, 8.2)
# about 14 points per square metre
NUM_POINTS = 1800


def fit_detail(building: Building, detail: str, max_parts: int = 1) -> Reconstruction:
    (reconstruction,) = fit([building], Reconstruct(detail=detail, max_parts=max_parts))
    return reconstruction


@pytest.mark.parametrize("chimney", [ON_SLOPE, AT_RIDGE, BESIDE_EAVE, ON_GABLE])
@pytest.mark.parametrize("max_parts", [1, 4])
def test_a_chimney_is_built_at_detail_high_only(chimney: tuple[float, ...], max_parts: int) -> None:
    x0, x1, y0, y1, top = chimney
    building, without = house(chimney, num_points=NUM_POINTS), house(num_points=NUM_POINTS)
    normal, high = (fit_detail(building, detail, max_parts) for detail in ("normal", "high"))
    mesh = high.mesh
    assert mesh.is_closed and is_sound(mesh)
    assert high.num_parts == 1 and high.mesh.vertex_m[:, 2].max() == pytest.approx(max(top, RIDGE_M), abs=0.1)
    at = np.array([[(x0 + x1) / 2, (y0 + y1) / 2]])
    beside = at + np.array([[-0.7, 0.0], [0.0, 0.7]])
    for reconstruction, expected in ((high, top), (normal, roof_z(at)[0])):
        height, _ = roof_over(
            reconstruction.mesh.vertex_m, reconstruction.mesh.triangle, np.vstack([at, beside])
        )
        assert height[0] == pytest.approx(expected, abs=0.1)
        assert height[1:] == pytest.approx(roof_z(beside), abs=0.1)
    # upright walls up to a level top, nothing beyond the footprint
    assert volume(high) - volume(normal) == pytest.approx(true_volume(chimney) - true_volume(), abs=0.2)
    assert (high.mesh.vertex_m[:, :2] > -1e-6).all() and (
        high.mesh.vertex_m[:, :2] < [WIDE_M + 1e-6, DEEP_M + 1e-6]
    ).all()
    plain = fit_detail(without, "normal", max_parts)
    assert len(normal.mesh.triangle) == len(plain.mesh.triangle) < len(high.mesh.triangle)
    # a chimney at the wall stands on it
    wall_m = 14.0 if chimney is ON_GABLE else np.inf
    assert (
        not np.isfinite(wall_m)
        or (high.mesh.vertex_m[np.abs(high.mesh.vertex_m[:, 2] - top) < 0.1, 0] == wall_m).any()
    )


def crown(building: Building) -> Building:
    """Returns of class building from a tree whose crown reaches over the roof: at all heights, with the roof between
    them."""
    rng = np.random.default_rng(5)
    z_m = rng.uniform(8.0, 11.0, 25)
    radius_m, turn = 1.2 * np.sqrt(rng.random(25)), rng.uniform(0, 2 * np.pi, 25)
    xy_m = np.array([7.0, 1.0]) + radius_m[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    return with_points(building, np.column_stack([xy_m, z_m]))


def with_points(building: Building, point_m: np.ndarray) -> Building:
    point_m = np.vstack([building.point_m, point_m])
    return replace(building, point_m=point_m, classification=np.full(len(point_m), 6))


def test_neither_a_tree_nor_birds_nor_a_mast_become_a_chimney() -> None:
    plain = house(num_points=NUM_POINTS)
    expected = fit_detail(plain, "normal")
    mast = np.column_stack([np.full(4, 7.0), np.full(4, 3.0), np.linspace(8.0, 11.0, 4)])
    pair = np.array([[5.0, 2.0, 8.0], [5.2, 2.1, 8.02]])
    # at one height, far above the roof
    wires = np.array([[5.0, 2.0, 11.0], [5.2, 2.1, 11.0], [5.1, 2.3, 11.02], [4.9, 2.2, 11.01]])
    # the eave of a higher neighbour: a row of returns along the wall
    row = np.column_stack([np.arange(4.0, 6.0, 0.2), np.full(10, 0.05), np.full(10, 6.5)])
    for building in (
        crown(plain),
        *(with_points(plain, each) for each in (mast, pair, wires, row, pair[:1])),
    ):
        high = fit_detail(building, "high")
        assert len(high.mesh.triangle) == len(expected.mesh.triangle)
        assert high.mesh.vertex_m[:, 2].max() == pytest.approx(expected.mesh.vertex_m[:, 2].max(), abs=0.1)


def test_three_returns_make_a_chimney_and_dormers_switch_it_off() -> None:
    place = np.array([[6.1, 2.1, 8.3], [6.4, 2.2, 8.32], [6.2, 2.5, 8.28]])
    building = house(num_points=NUM_POINTS)
    around = np.abs(building.point_m[:, :2] - [6.25, 2.3]).max(axis=1) < 0.3
    cleared = replace(building, point_m=building.point_m[~around])
    assert len(fit_detail(with_points(cleared, place[:2]), "high").mesh.triangle) == len(
        fit_detail(building, "normal").mesh.triangle
    )
    shown = with_points(cleared, place)
    high = fit_detail(shown, "high")
    height, _ = roof_over(high.mesh.vertex_m, high.mesh.triangle, np.array([[6.25, 2.3]]))
    assert height[0] == pytest.approx(8.3, abs=0.05)
    (off,) = fit([shown], Reconstruct(detail="high", dormers=False, max_parts=1))
    assert len(off.mesh.triangle) == len(fit_detail(building, "normal").mesh.triangle)


def test_on_by_default() -> None:
    assert Reconstruct().dormers
    building = house(AT_WALL, WITHIN)
    (default,) = fit([building], Reconstruct(max_parts=1))
    assert default.mesh.vertex_m.tobytes() == fit_one(building, dormers=True).mesh.vertex_m.tobytes()
    assert len(default.mesh.triangle) > len(fit_one(building, dormers=False).mesh.triangle)


def test_height_over_a_mesh() -> None:
    box = trimesh.creation.box(bounds=[[0, 0, 0], [2, 2, 3]])
    height, slant = roof_over(box.vertices, box.faces, np.array([[1.0, 0.5], [3.0, 1.0]]))
    assert height[0] == 3 and height[1] == -np.inf and slant.tolist() == [1, 1]

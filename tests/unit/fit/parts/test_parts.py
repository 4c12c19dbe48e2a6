"""Buildings with several heights: cuts lie where the heights change, and the union is one closed manifold."""

import numpy as np
import pytest
import shapely
import trimesh
from toy_roofs import sample

from p2wss.fit.mesh.union import is_sound, union
from p2wss.fit.parts.merging import merged_rings
from p2wss.fit.parts.partition import fit_parts
from p2wss.fit.parts.parts import main_frame, total_cost_m
from p2wss.fit.roof.fitter import FittedRoof, Fitter
from p2wss.fit.settings import Cutting, Effort, Limits
from p2wss.mesh.topology import is_closed
from p2wss.skeleton import FaceKind

HOUSE = np.array([[0, 0], [9, 0], [9, 8], [0, 8.0]])
ANNEX = np.array([[9, 0], [13, 0], [13, 8], [9, 8.0]])
BOTH = np.array([[0, 0], [13, 0], [13, 8], [0, 8.0]])


def house_with_annex(noise_m: float = 0.03) -> np.ndarray:
    house = sample([HOUSE], [90, 40, 90, 40], 6.0, 500, noise_m)
    return np.vstack([house, sample([ANNEX], [0] * 4, 3.0, 250, noise_m, seed=1)])


def roof(ring: np.ndarray, angle_deg: list[float], eave_z_m: float) -> FittedRoof:
    return FittedRoof([ring], np.array(angle_deg, float), eave_z_m, 0.0, 1)


def test_house_and_annex_are_cut_where_they_meet() -> None:
    parts = fit_parts(Fitter(Limits()), [BOTH], house_with_annex(), Effort(), Cutting())
    assert len(parts) == 2
    low, high = sorted(parts, key=lambda part: part.eave_z_m)
    assert low.eave_z_m == pytest.approx(3.0, abs=0.05) and low.angle_deg.tolist() == [0] * 4
    assert high.eave_z_m == pytest.approx(6.0, abs=0.1)
    assert np.sort(high.angle_deg) == pytest.approx([40, 40, 90, 90], abs=1.5)
    cut = set(low.rings[0][:, 0].tolist()) & set(high.rings[0][:, 0].tolist())
    assert len(cut) == 1 and cut.pop() == pytest.approx(9, abs=0.15)


def test_no_more_parts_than_allowed_and_none_without_a_reason() -> None:
    fitter = Fitter(Limits())
    assert len(fit_parts(fitter, [BOTH], house_with_annex(), Effort(), Cutting(max_parts=1))) == 1
    single = sample([BOTH], [40, 90, 40, 90], 6.0, 600, 0.05)
    assert len(fit_parts(fitter, [BOTH], single, Effort(), Cutting())) == 1


def test_parts_are_not_worse_than_one_height() -> None:
    point_m = house_with_annex(0.3)
    fitter = Fitter(Limits())
    single = fit_parts(fitter, [BOTH], point_m, Effort(), Cutting(max_parts=1))
    parts = fit_parts(fitter, [BOTH], point_m, Effort(), Cutting())
    assert len(parts) == 2
    # including the cost of a part
    assert total_cost_m(parts, Cutting()) < total_cost_m(single, Cutting())
    assert total_cost_m(parts, Cutting(mean_price_m=0.5)) == pytest.approx(
        sum(p.total_loss_m for p in parts) + 0.5 * 750
    )


def test_an_annex_in_a_corner_leaves_one_part_around_it() -> None:
    """Straight cuts alone need three parts; two of them are merged, and their roof stays one."""
    ring = np.array([[0, 0], [14, 0], [14, 10], [0, 10.0]])
    point_m = np.column_stack(
        [np.random.default_rng(2).uniform((0, 0), (14, 10), (900, 2)), np.full(900, 6.0)]
    )
    point_m[(point_m[:, 0] > 9) & (point_m[:, 1] > 6), 2] = 3.0
    point_m[:, 2] += np.random.default_rng(3).normal(0, 0.03, 900)
    parts = fit_parts(Fitter(Limits()), [ring], point_m, Effort(), Cutting())
    low, high = sorted(parts, key=lambda part: part.eave_z_m)
    assert [len(part.rings[0]) for part in (low, high)] == [4, 6]
    assert shapely.Polygon(low.rings[0]).area == pytest.approx(20, rel=0.1)
    assert max(part.loss_m for part in parts) < 0.06


def test_slopes_have_their_price() -> None:
    """A roof that rises by 12 cm over 4 m is not worth two slopes, one that rises by a metre is."""
    for angle_deg, is_flat in ((2.0, True), (14.0, False)):
        point_m = sample([HOUSE], [5.0, 90, 5.0, 90], 6.0, 500, 0.03)
        y = np.minimum(point_m[:, 1], 8 - point_m[:, 1])
        point_m[:, 2] = (
            6.0 + np.tan(np.radians(angle_deg)) * y + np.random.default_rng(1).normal(0, 0.03, 500)
        )
        (part,) = fit_parts(Fitter(Limits()), [HOUSE], point_m, Effort(), Cutting())
        assert (part.angle_deg == 0).all() == is_flat


def test_merged_rings() -> None:
    (merged,) = merged_rings([HOUSE], [ANNEX])
    assert len(merged) == 4 and shapely.Polygon(merged).equals(shapely.Polygon(BOTH))
    for shift_m in ((1.0, 0.0), (0.0, 8.0)):
        assert merged_rings([HOUSE], [ANNEX + np.array(shift_m)]) is None
    hole = [BOTH * 10, ANNEX[::-1] + 5]
    assert len(merged_rings(hole, [BOTH * 10 + np.array([130.0, 0.0])])) == 2


def test_a_handful_of_points_is_no_reason_to_cut() -> None:
    point_m = house_with_annex(0.3)[::50]
    few = fit_parts(Fitter(Limits()), [BOTH], point_m, Effort(), Cutting(min_price_m=100.0))
    assert len(few) == 1


@pytest.mark.parametrize(
    "parts",
    [
        [roof(HOUSE, [90, 40, 90, 40], 6.0), roof(ANNEX, [0] * 4, 3.0)],
        # crossing roofs: each is higher somewhere along the cut
        [roof(HOUSE, [30, 90, 90, 90], 5.0), roof(ANNEX, [90, 90, 30, 90], 5.0)],
        [roof(HOUSE, [45] * 4, 4.0), roof(ANNEX, [90, 20, 90, 90], 3.0)],
        # the same height: one flat roof
        [roof(HOUSE, [0] * 4, 4.0), roof(ANNEX, [0] * 4, 4.0)],
    ],
)
def test_unions_are_closed_and_have_the_volume_of_the_parts(parts: list[FittedRoof]) -> None:
    mesh = union(parts, 1.0, 12.0)
    assert mesh is not None and mesh.is_closed
    solid = trimesh.Trimesh(mesh.vertex_m, mesh.triangle, process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.body_count == 1
    separate = [union([part], 1.0, 12.0) for part in parts]
    volumes = [trimesh.Trimesh(m.vertex_m, m.triangle, process=False).volume for m in separate if m]
    assert solid.volume == pytest.approx(sum(volumes), rel=1e-3)
    ground = mesh.kind == FaceKind.GROUND
    assert solid.area_faces[ground].sum() == pytest.approx(shapely.Polygon(BOTH).area, rel=1e-3)


def test_coplanar_faces_of_parts_are_one() -> None:
    mesh = union([roof(HOUSE, [0] * 4, 4.0), roof(ANNEX, [0] * 4, 4.0)], 1.0, 12.0)
    assert mesh is not None
    assert (len(mesh.vertex_m), len(mesh.triangle)) == (8, 12)
    faces = mesh.surfaces
    assert sorted(face.kind for face in faces) == sorted([0, 1, 1, 1, 1, 3])


def test_an_edge_of_millimetres_is_closed_up_without_folding_a_face() -> None:
    """Two parts of a real house whose ridges end within 3 mm of each other."""
    west = np.array([[15.95, 5.29], [0, 5.13], [2.06, 0.09], [15.95, 0]])
    east = [[15.95, 0], [19.14, -0.02], [19.07, 5.18], [21.88, 5.16], [21.82, 9.73], [15.95, 9.76]]
    east += [[16.01, 5.29], [15.95, 5.29]]
    parts = [
        roof(west, [41, 69, 39, 52], 6.156),
        roof(np.array(east), [54.4, 90, 54.4, 30.7, 90, 28.5, 55.1, 90], 4.919),
    ]
    mesh = union(parts, 1.0, 12.0)
    assert mesh is not None and mesh.is_closed and is_sound(mesh)
    corner = mesh.vertex_m[mesh.triangle]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    for plane in np.unique(mesh.label):
        in_plane = normal[mesh.label == plane]
        assert (in_plane @ in_plane.sum(axis=0) > 0).all()


def test_is_closed_notices_a_hole_and_a_flipped_triangle() -> None:
    box = trimesh.creation.box()
    vertex_m, triangle = np.asarray(box.vertices), np.asarray(box.faces)
    assert is_closed(vertex_m, triangle)
    assert not is_closed(vertex_m, triangle[1:])
    flipped = triangle.copy()
    flipped[0] = flipped[0][::-1]
    assert not is_closed(vertex_m, flipped)


def test_main_frame_is_that_of_the_edges() -> None:
    turn = np.radians(31.7)
    turned = BOTH @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    level = turned @ main_frame([turned])
    along = np.abs(np.roll(level, -1, axis=0) - level)
    assert along.min(axis=1) == pytest.approx(0, abs=1e-9)


def test_triangles_are_grouped_by_the_planes_they_lie_in() -> None:
    mesh = union([roof(HOUSE, [90, 40, 90, 40], 6.0), roof(ANNEX, [0] * 4, 3.0)], 2.0, 12.0)
    assert mesh is not None
    same = trimesh.Trimesh(mesh.vertex_m, mesh.triangle, process=False)
    flat = same.face_adjacency[same.face_adjacency_angles < 1e-3]
    groups = trimesh.graph.connected_components(flat, nodes=np.arange(len(mesh.triangle)))
    assert sorted(map(sorted, groups)) == sorted(
        np.flatnonzero(mesh.label == plane).tolist() for plane in np.unique(mesh.label)
    )
    up = same.face_normals[:, 2]
    expected = np.where(np.abs(up) < 0.01, FaceKind.WALL, np.where(up < 0, FaceKind.GROUND, FaceKind.ROOF))
    assert np.array_equal(mesh.kind, np.where(up > 0.9999, FaceKind.FLAT, expected))

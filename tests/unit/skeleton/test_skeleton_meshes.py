"""Every mesh is sound, as judged by independent programs; queries and faces agree with the meshes."""

import numpy as np
import pytest
from skeleton_samples import REGIMES, clean, sample_angles, sample_footprints
from skeleton_solids import crosses_itself, judged_sound, volumes

from p2wss.mesh import Mesh
from p2wss.skeleton import FaceKind, build, roof_points


def judge(num, regime, court_share, seed):
    polygons = clean(sample_footprints(num, seed, court_share))
    meshes = build(polygons, sample_angles(polygons, regime, seed), np.full(num, 5.0))
    assert (meshes.status == 0).mean() >= 0.999
    num_courtyards = np.diff(polygons.polygon_offset) - 1
    wrong = []
    for k in np.flatnonzero(meshes.status == 0):
        vertex, triangle, _, _ = meshes.mesh(k)
        assert len(triangle) == 2 * len(vertex) - 4 + 4 * num_courtyards[k]
        verdict = judged_sound(vertex, triangle, num_courtyards[k])
        if verdict:
            wrong.append((k, verdict))
    assert not wrong


@pytest.mark.parametrize("regime", REGIMES)
def test_independent_judges(regime):
    judge(60, regime, 0.3, 11)


@pytest.mark.slow
@pytest.mark.parametrize("regime", REGIMES)
def test_independent_judges_on_many(regime):
    judge(4000, regime, 0.25, 12)


def test_the_judge_notices_a_crossing():
    apart = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1, 1], [5, 5, 1]], float)
    assert crosses_itself(apart, np.array([[0, 1, 2], [3, 4, 5]]))
    assert not crosses_itself(
        apart + np.repeat([[0, 0, 0], [9, 0, 0]], 3, axis=0), np.array([[0, 1, 2], [3, 4, 5]])
    )


@pytest.mark.parametrize("num", [40, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("regime", REGIMES)
def test_no_mesh_crosses_itself(regime, num):
    polygons = clean(sample_footprints(num, 13, 0.25))
    meshes = build(polygons, sample_angles(polygons, regime, 13), np.full(num, 5.0))
    assert [k for k in range(num) if crosses_itself(*meshes.mesh(k)[:2])] == []


@pytest.mark.parametrize("regime", REGIMES)
def test_heights_on_the_roof_equal_the_mesh(regime):
    polygons = clean(sample_footprints(200, 5, 0.3))
    angle, eave = sample_angles(polygons, regime, 6), np.linspace(3, 9, 200)
    meshes = build(polygons, angle, eave, max_roof_height_m=4.0)
    rng = np.random.default_rng(0)
    points, index, kinds = [], [], []
    for k in range(200):
        vertex, triangle, kind, _ = meshes.mesh(k)
        top = rng.choice(np.flatnonzero(np.isin(kind, [FaceKind.ROOF, FaceKind.FLAT])), 5)
        points.append(np.einsum("ij,ijk->ik", rng.dirichlet([1, 1, 1], 5), vertex[triangle[top]]))
        index += [k] * 5
        kinds.append(kind[top])
    points, index = np.concatenate(points), np.array(index)
    shuffle = rng.permutation(len(points))
    roof = roof_points(polygons, angle, eave, points[shuffle, :2], index[shuffle], max_roof_height_m=4.0)
    np.testing.assert_allclose(roof.z_m, points[shuffle, 2], atol=1e-6)
    assert ((roof.edge >= 0) == (np.concatenate(kinds)[shuffle] == FaceKind.ROOF)).all()


def test_a_higher_eave_raises_the_roof_and_nothing_else():
    polygons = clean(sample_footprints(150, 8, 0.3))
    angle = sample_angles(polygons, "one", 9) + np.random.default_rng(1).uniform(-4, 4, len(polygons.xy_m))
    rng = np.random.default_rng(2)
    index = rng.integers(0, 150, 600)
    centre = np.array([polygons.rings(k)[0].mean(0) for k in range(150)])
    xy = centre[index] + rng.uniform(-4, 4, (600, 2))
    roof = roof_points(polygons, angle, 5.0, xy, index)
    raised = roof_points(polygons, angle, 5.5, xy, index)
    np.testing.assert_allclose(raised.z_m, roof.z_m + 0.5)
    assert (raised.edge == roof.edge).all() and np.isnan(roof.z_m).any()


def test_faces_by_the_labels_are_planar_and_enclose_the_mesh_volume():
    """Triangles of equal kind and edge that share a side are one face, as the writer of CityJSON takes them."""
    polygons = clean(sample_footprints(100, 3, 0.4))
    meshes = build(polygons, sample_angles(polygons, "iid", 3), np.full(100, 5.0))
    expected = volumes(meshes)
    for k in range(100):
        vertex, triangle, _, _ = meshes.mesh(k)
        local, volume, sides = vertex - vertex[0], 0.0, set()
        surfaces = Mesh.of_kernel(meshes, k).surfaces
        assert len(surfaces) < len(triangle)
        for surface in surfaces:
            corner = vertex[np.concatenate(surface.rings)]
            assert np.linalg.svd(corner - corner.mean(axis=0))[1][2] < 1e-6
            for ring in surface.rings:
                a, b, c = local[ring[0]], local[ring[1:-1]], local[ring[2:]]
                volume += float(np.sum(np.cross(b, c) @ a) / 6)
                for side in zip(ring.tolist(), np.roll(ring, -1).tolist(), strict=True):
                    assert side not in sides
                    sides.add(side)
        assert volume == pytest.approx(expected[k], rel=1e-9)
        assert {(b, a) for a, b in sides} == sides

"""Clean-up and meshes of shapes with known results."""

import numpy as np
import pytest

from p2wss.skeleton import FaceKind, Polygons, Status, build
from p2wss.skeleton import status as plain

SQUARE = np.array([[0, 0], [10, 0], [10, 10], [0, 10]], float)
RECTANGLE = np.array([[0, 0], [10, 0], [10, 6], [0, 6]], float)
L_SHAPE = np.array([[0, 0], [10, 0], [10, 4], [4, 4], [4, 10], [0, 10]], float)
COURTYARD = np.array([[3, 3], [3, 7], [7, 7], [7, 3]], float)


def test_the_plain_integers_of_compiled_code_are_those_of_the_status() -> None:
    assert {member.name: getattr(plain, member.name) for member in Status} == dict(Status.__members__)


def volume(vertex, triangle):
    a, b, c = (vertex[triangle[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def build_one(rings, angle_deg, eave_height_m=5.0, **kwargs):
    meshes = build(
        Polygons.from_rings([rings]), np.asarray(angle_deg, float), np.array([eave_height_m]), **kwargs
    )
    assert Status(meshes.status[0]) == Status.OK
    return meshes.mesh(0)


@pytest.mark.parametrize(
    ("rings", "angle_deg", "expected_m3", "expected_top_m"),
    [
        ([RECTANGLE], [45] * 4, 300 + 72, 8),  # hip: h w (3 l - w) / 6
        ([RECTANGLE], [45, 90, 45, 90], 300 + 90, 8),  # gable
        ([RECTANGLE], [45, 90, 90, 90], 300 + 0.5 * 6 * 6 * 10, 11),  # shed
        ([RECTANGLE], [90] * 4, 300, 5),
        ([RECTANGLE], [0] * 4, 300, 5),
        ([RECTANGLE], [0, 45, 30, 90], 300, 5),  # one 0 degree edge sweeps a rectangle
        ([SQUARE], [45] * 4, 500 + 500 / 3, 10),
        ([L_SHAPE], [90, 90, 0, 45, 90, 45], 64 * 5 + 40, 7),  # an inner 0 edge flattens its wing only
        ([SQUARE, COURTYARD], [45] * 8, 84 * 5 + 63, 6.5),
        ([SQUARE, COURTYARD], [90] * 8, 84 * 5, 5),
        ([SQUARE, COURTYARD], [90] * 4 + [45] * 4, None, 8),
    ],
)
def test_known_solids(rings, angle_deg, expected_m3, expected_top_m):
    vertex, triangle, kind, edge = build_one(rings, angle_deg)
    assert vertex[:, 2].max() == pytest.approx(expected_top_m, abs=1e-9)
    assert vertex[:, 2].min() == 0
    if expected_m3 is not None:
        assert volume(vertex, triangle) == pytest.approx(expected_m3, rel=1e-9)
    assert len(triangle) == 2 * len(vertex) - 4 + 4 * (len(rings) - 1)
    assert ((edge >= 0) == np.isin(kind, [FaceKind.WALL, FaceKind.ROOF])).all()
    # a face id of a scan has two bits for the kind
    assert kind.max() <= 3


def test_gable_merges_with_its_wall():
    _, triangle, kind, edge = build_one([RECTANGLE], [45, 90, 45, 90])
    assert len(triangle) == 16  # ground 2, walls 2 + 2, gable walls 3 + 3, roofs 2 + 2
    assert [(kind[edge == e] == FaceKind.WALL).sum() for e in range(4)] == [2, 3, 2, 3]


def test_maximum_height_base_and_frame():
    shift = np.array([652_000.25, 6_862_000.5])
    vertex, triangle, kind, _ = build_one(
        [SQUARE + shift], [45] * 4, 105.0, base_height_m=98.0, max_roof_height_m=2.0
    )
    assert vertex[:, 2].min() == 98 and vertex[:, 2].max() == 107
    local = vertex - [*shift, 98]
    assert volume(local, triangle) == pytest.approx(700 + 2 / 3 * (100 + 36 + 60), rel=1e-9)
    assert (kind == FaceKind.FLAT).sum() == 2


def test_bad_arguments_get_a_status():
    polygons = Polygons.from_rings([[SQUARE]] * 6)
    angle = np.full((6, 4), 45.0)
    angle[0, 0], angle[1, 0], angle[2, 0] = np.nan, 89, -1
    eave = np.array([5, 5, 5, np.nan, 0, 5.0])
    status = build(polygons, angle.ravel(), eave).status
    assert status.tolist() == [Status.BAD_ANGLE] * 3 + [Status.BAD_HEIGHT] * 2 + [Status.OK]
    with pytest.raises(ValueError, match="angle_deg"):
        build(polygons, np.zeros(3), eave)


@pytest.mark.parametrize(
    ("rings", "status"),
    [
        ([], Status.EMPTY),
        ([np.zeros((0, 2))], Status.EMPTY),
        ([np.array([[0, 7], [10, 0], [10, 10], [0, 0.0]])], Status.NOT_SIMPLE),
        ([SQUARE * np.nan], Status.NON_FINITE),
        ([SQUARE + np.inf], Status.NON_FINITE),
        ([SQUARE, COURTYARD + 20], Status.COURTYARD_OUTSIDE),
        ([SQUARE, COURTYARD + 5], Status.NOT_SIMPLE),
        ([SQUARE, COURTYARD, (COURTYARD - 5) / 2 + 5], Status.COURTYARD_OUTSIDE),
        ([SQUARE, COURTYARD - 3], Status.NOT_SIMPLE),
    ],
)
def test_polygons_that_are_not_simple_are_rejected(rings, status):
    polygons = Polygons.from_rings([[SQUARE], rings, [SQUARE]])
    meshes = build(polygons, np.full(len(polygons.xy_m), 90.0), np.full(3, 5.0))
    assert [Status(s) for s in meshes.status] == [Status.OK, status, Status.OK]


def test_reasons_are_in_kebab_case():
    assert Status.NOT_SIMPLE.reason == "not-simple"
    assert Status.OK == 0

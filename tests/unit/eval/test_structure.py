"""False and missing edges of roofs that are known."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh
from drawn_towns.planes import mesh_of as of_triangles
from places import ROOT

import p2wss
from p2wss.eval.metrics import false_and_missing_share, roof_edges
from p2wss.mesh import Mesh

sys.path.insert(0, str(ROOT / "benchmarks"))
from roof_edges import EDGE_KINDS, HIGH_STEP, LOW_FOLD, OUTER, structure

HOUSE = [[0, 0], [10, 0], [10, 6], [0, 6]]


def mesh_of(body: trimesh.Trimesh) -> Mesh:
    return of_triangles(np.asarray(body.vertices), np.asarray(body.faces).astype(np.int32))


def box(x: float, width: float, height: float) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[[x, 0, 0], [x + width, 6, height]])


GABLE = mesh_of(p2wss.roof(HOUSE, 5, [45, 90, 45, 90]))
# a ridge of 26 cm, whose ends are near the eaves, that a level roof does not have
CAMBERED = mesh_of(p2wss.roof(HOUSE, 5, [5, 90, 5, 90]))
LEVEL = mesh_of(p2wss.roof(HOUSE, 5, 0))
STEPPED = mesh_of(box(0, 4, 5).union(box(4, 6, 8)))


def test_the_edges_of_a_gable_are_two_rectangles() -> None:
    edges = roof_edges(GABLE)
    length = np.linalg.norm(np.diff(edges.corner_m[edges.edge], axis=1), axis=2).sum()
    assert len(edges.corner_m) == 6 and length == pytest.approx(3 * 10 + 4 * np.hypot(3, 3))


def test_a_roof_is_its_own_truth() -> None:
    for mesh in (GABLE, CAMBERED, LEVEL, STEPPED):
        result = structure(mesh, mesh)
        assert result.is_exact and result.false_m == result.missing_m == 0
        assert len(set(result.corners)) == 1


def test_what_is_false_and_what_it_is() -> None:
    result = structure(CAMBERED, LEVEL)
    assert result.false_by_kind_m[LOW_FOLD] == pytest.approx(9, abs=0.5) and result.missing_m == 0
    assert sum(result.false_by_kind_m.values()) == pytest.approx(result.false_m)
    assert not result.is_exact and set(result.false_by_kind_m) == set(EDGE_KINDS)
    # the lower edge of a step and the upper one, and the other walls of the higher half
    stepped = structure(STEPPED, LEVEL)
    assert stepped.false_by_kind_m[HIGH_STEP] == pytest.approx(12, abs=1.5)
    assert stepped.false_by_kind_m[OUTER] == pytest.approx(18, abs=1.5)
    assert structure(LEVEL, CAMBERED).missing_m == pytest.approx(9, abs=0.5)


def test_shares_of_the_length_are_those_of_the_report() -> None:
    false_share, missing_share = false_and_missing_share(CAMBERED, LEVEL)
    assert false_share == pytest.approx(9 / (3 * 10 + 4 * np.hypot(3, 0.26)), abs=0.02) and missing_share == 0
    assert false_and_missing_share(LEVEL, CAMBERED) == (0, pytest.approx(false_share, abs=0.02))


def test_without_a_mesh_all_is_missing() -> None:
    result = structure(Mesh.empty(), LEVEL)
    assert (result.edges_m, result.false_m, result.corners) == (0, 0, (0, 0, 4))
    assert result.missing_m == result.true_m > 0 and not result.is_exact

"""Agreement with SFCGAL, an independent exact implementation."""

import numpy as np
import pytest
from sfcgal import sfcgal_volumes
from skeleton_samples import REGIMES, clean, sample_angles, sample_footprints
from skeleton_solids import volumes

from p2wss.skeleton import Polygons, build

pytest.importorskip("pysfcgal")


def mean_height_differs(kernel_m3, sfcgal_m3, box):
    """Whether mean roof heights differ by more than a millimetre or volumes by more than 0.1 %.

    kernel_m3, sfcgal_m3: roof volumes. box: of the walls, which are 5 m high.
    """
    agree = np.abs(kernel_m3 - sfcgal_m3) / (box / 5) < 1e-3
    return ~(agree & (np.abs(kernel_m3 - sfcgal_m3) < 1e-3 * (box + sfcgal_m3)))


def on_a_tie(rings, angle, sfcgal_m3):
    """Whether moving the corners by at most a micrometre gives the volume of SFCGAL: rounding decides here."""
    rng = np.random.default_rng(0)
    moved = [
        [r + size * rng.normal(size=r.shape) for r in rings] for size in (1e-9, 1e-7, 1e-6) for _ in range(20)
    ]
    polygons = Polygons.from_rings(moved)
    eave = np.full(len(moved), 5.0)
    box = volumes(build(polygons, np.full(len(moved) * len(angle), 90.0), eave))
    kernel_m3 = volumes(build(polygons, np.tile(angle, len(moved)), eave)) - box
    return not mean_height_differs(kernel_m3, sfcgal_m3, box).all()


def compare(num, regime, court_share):
    """Numbers of buildings that agree, that differ, that are capped, ambiguous or on a tie, without an answer."""
    polygons = clean(sample_footprints(num, 3, court_share))
    angle = sample_angles(polygons, regime, 4)
    eave = np.full(num, 5.0)
    meshes = build(polygons, angle, eave)
    assert (meshes.status == 0).all()
    box = volumes(build(polygons, np.full(len(angle), 90.0), eave))
    kernel_m3 = volumes(meshes) - box
    # SFCGAL takes 0 for 90 degrees, but 1e-4 for 0. Roofs with 90 degrees only rise without end there.
    sfcgal_m3, _ = sfcgal_volumes(polygons, np.where(angle == 0, 1e-4, angle))
    differ = mean_height_differs(kernel_m3, sfcgal_m3, box)
    silent = np.isnan(sfcgal_m3)
    capped = differ & (meshes.num_caps > 0)
    ambiguous = differ & ~capped & (meshes.num_ambiguous > 0)
    for k in np.flatnonzero(differ & ~capped & ~ambiguous & ~silent):
        edges = slice(polygons.vertex_offset[k], polygons.vertex_offset[k + 1])
        ambiguous[k] = on_a_tie(polygons.rings(k), angle[edges], sfcgal_m3[k])
    silent &= ~capped & ~ambiguous
    return tuple(
        int(x.sum()) for x in (~differ, differ & ~capped & ~ambiguous & ~silent, capped, ambiguous, silent)
    )


def test_two_courtyards_on_a_tie():
    # the one kind of difference that no count of the kernel explains: with all walls exactly parallel, SFCGAL
    # finds 1349.9 m3 and the kernel 1167.9; with the corners moved by a micrometre both find either volume
    rings = [
        [[0, 0], [32.12618813, -14.0597404], [41.6062369, 7.60195616], [9.48004878, 21.66169657]],
        [
            [5.11523096, 2.61470195],
            [11.50607957, 17.21764616],
            [22.35832256, 12.46825857],
            [15.96747395, -2.13468564],
        ],
        [
            [19.63191339, -3.73839496],
            [26.022762, 10.86454925],
            [36.47407766, 5.1990518],
            [30.48415638, -8.48778255],
        ],
    ]
    rings = [np.array(ring, float) for ring in rings]
    angle = np.array([90, 28, 90, 45, 28, 22, 26, 90, 90, 23, 22, 90.0])
    assert on_a_tie(rings, angle, 1349.93) and on_a_tie(rings, angle, 1167.95)
    assert not on_a_tie(rings, angle, 1250.0)


@pytest.mark.parametrize("regime", ["one", "iid", "many-90"])
@pytest.mark.parametrize("court_share", [0.0, 1.0])
def test_agrees_with_sfcgal(regime, court_share):
    agree, differ, capped, ambiguous, silent = compare(40, regime, court_share)
    assert differ == 0 and agree >= 34, (agree, differ, capped, ambiguous, silent)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("court_share", [0.0, 1.0])
def test_agrees_with_sfcgal_on_many(regime, court_share):
    agree, differ, capped, ambiguous, silent = compare(2000, regime, court_share)
    print(f"{regime} court_share={court_share}: {agree=} {differ=} {capped=} {ambiguous=} {silent=}")
    assert silent <= 0.001 * 2000
    assert agree >= 0.999 * (agree + differ)
    # the clean-up makes edges exactly parallel, so the open case is common among many 90 degree edges
    assert capped + ambiguous <= 0.12 * 2000

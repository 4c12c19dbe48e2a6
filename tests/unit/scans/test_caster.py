"""The cast against exact geometry, and what the sensor records."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from p2wss.config import Scans
from p2wss.scans.caster import Caster, cast
from p2wss.scans.pulses import Box
from p2wss.scans.surface import Surface, encode_face
from p2wss.scans.survey import PATTERNS, plan
from p2wss.scans.terrain import local_grid

HALF_M = 40
BOX = Box(-30.0, -30.0, 30.0, 30.0, -2.0, 40.0)
ROOF, WALL = 2, 1


def block(x0, y0, x1, y1, top, bottom=-1.0):
    """Vertices, triangles and kinds of a box without its floor, facing outwards."""
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    vertex = np.array([[x, y, z] for z in (bottom, top) for x, y in corners], float)
    triangle = [(4, 5, 6), (4, 6, 7)]
    for i in range(4):
        j = (i + 1) % 4
        triangle += [(i, j, j + 4), (i, j + 4, i + 4)]
    return vertex, np.array(triangle, np.int32), np.array([ROOF] * 2 + [WALL] * 8)


def surface(blocks, loss=0.0):
    """Flat terrain at 0 and boxes."""
    vertex, triangle, kind, owner, count = [np.zeros((0, 3))], [np.zeros((0, 3), np.int32)], [], [], 0
    for b, (v, t, k) in enumerate(blocks):
        vertex.append(v)
        triangle.append(t + count)
        kind.append(k)
        owner.append(np.full(len(t), b, np.int32))
        count += len(v)
    kinds = np.concatenate(kind) if kind else np.zeros(0, int)
    flat = np.zeros((2 * HALF_M, 2 * HALF_M), np.float32)
    return Surface(
        local_grid(flat, -HALF_M, HALF_M, 1.0, np.zeros(3)),
        np.concatenate(vertex),
        np.concatenate(triangle).astype(np.int32),
        np.concatenate(owner) if owner else np.zeros(0, np.int32),
        encode_face(kinds, np.zeros(len(kinds), np.int32)),
        np.full(len(kinds), 0.3, np.float32),
        np.full(len(kinds), loss, np.float32),
    )


def tilted(blocks, rng):
    """The same boxes, each turned a little about every axis, so that no face is aligned."""
    turned = []
    for v, t, k in blocks:
        middle = v.mean(axis=0)
        q, _ = np.linalg.qr(np.eye(3) + 0.2 * rng.normal(size=(3, 3)))
        turned.append(((v - middle) @ (q * np.sign(np.diag(q))).T + middle, t, k))
    return turned


TOWN = [
    block(x, y, x + 6, y + 5, 6 + (x * 7 + y * 3) % 11) for x in range(-28, 24, 10) for y in range(-27, 24, 9)
]


def only(pattern):
    return {name: float(name == pattern) for name in PATTERNS}


def plan_strips(preset, **changes):
    settings = Scans(preset=preset, **{"density_per_m2": 30, "density_bounds_per_m2": (30, 30), **changes})
    return plan(settings, 11, BOX, BOX).strips


def first_hits(triangles, origin, direction, chunk=2000):
    """Exact first hit per ray, all triangles tested in float64 (Möller, Trumbore): index or -1, distance."""
    index, distance = np.full(len(origin), -1), np.full(len(origin), np.inf)
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    for start in range(0, len(origin), chunk):
        o, d = origin[start : start + chunk, None], direction[start : start + chunk, None]
        p = np.cross(d, e2[None])
        with np.errstate(divide="ignore", invalid="ignore"):
            det = (e1[None] * p).sum(-1)
            s = o - a[None]
            u = (s * p).sum(-1) / det
            q = np.cross(s, e1[None])
            v = (d * q).sum(-1) / det
            t = (e2[None] * q).sum(-1) / det
        t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf)
        best = t.argmin(axis=1)
        nearest = t[np.arange(len(t)), best]
        index[start : start + chunk] = np.where(np.isfinite(nearest), best, -1)
        distance[start : start + chunk] = nearest
    return index, distance


@pytest.mark.parametrize("count", [10_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_points_are_the_exact_first_hits(count):
    scene = surface(tilted(TOWN, np.random.default_rng(0)))
    strips = plan_strips("none", density_per_m2=1.2 * count / 3600, pattern_shares=only("parallel"))[:1]
    points, counts = cast(scene, strips, BOX)
    path = strips[0].path
    # the same rays again, from the aircraft, in float64 and without any of the code under test
    time_s = points.pulse / path.pulse_rate_hz
    turns = time_s * path.scan_rate_hz + path.scan_phase
    angle = path.half_angle_rad * (2 * (turns - np.floor(turns)) - 1)
    ahead = np.array([np.cos(path.heading_rad), np.sin(path.heading_rad)])
    left = np.array([-ahead[1], ahead[0]])
    origin = np.empty((len(time_s), 3))
    start = np.array([path.start_x_m, path.start_y_m])
    origin[:, :2] = start + np.outer(path.speed_m_per_s * time_s, ahead)
    origin[:, 2] = path.altitude_m
    direction = np.column_stack([np.outer(np.sin(angle), left), -np.cos(angle)])

    corners = np.array([[-39.5, -39.5, 0], [39.5, -39.5, 0], [39.5, 39.5, 0], [-39.5, 39.5, 0]])
    ground = np.array([corners[[0, 1, 2]], corners[[0, 2, 3]]])
    triangles = np.concatenate([scene.vertex_m[scene.triangle], ground])
    index, distance = first_hits(triangles, origin, direction)
    expected = origin + distance[:, None] * direction
    error_m = np.linalg.norm(points.xyz_mm / 1000 - expected, axis=1)
    owner = np.append(scene.building, [-1, -1])[index]
    # half a millimetre of rounding per axis; a ray that grazes an edge may go either way
    wrong = (error_m > 1.5e-3) | (owner != points.building)
    assert len(index) > 0.5 * count
    assert wrong.mean() < 2e-4
    assert counts["lost"] == 0


def test_no_face_is_tagged_wrongly():
    points, _ = cast(surface(TOWN), plan_strips("none"), BOX)
    x, y, z = points.xyz_mm.T / 1000
    boxes = np.array([[*v.min(axis=0), *v.max(axis=0)] for v, _, _ in TOWN])
    ground = points.building < 0
    assert np.abs(z[ground]).max() <= 0.001
    assert (points.face[ground] == -1).all()
    kind, box = points.face[~ground] & 3, boxes[points.building[~ground]]
    x, y, z = x[~ground], y[~ground], z[~ground]
    to_wall = np.min([abs(x - box[:, 0]), abs(x - box[:, 3]), abs(y - box[:, 1]), abs(y - box[:, 4])], axis=0)
    assert set(kind) == {ROOF, WALL}
    assert np.abs(z - box[:, 5])[kind == ROOF].max() <= 0.001
    assert to_wall[kind == WALL].max() <= 0.001
    assert (z[kind == WALL] < box[kind == WALL, 5] + 0.001).all()


def test_a_deep_courtyard_gets_no_points():
    around = [
        block(-20, -20, 20, -1, 30),
        block(-20, 1, 20, 20, 30),
        block(-20, -1, -1, 1, 30),
        block(1, -1, 20, 1, 30),
    ]
    points, _ = cast(surface(around), plan_strips("none", pattern_shares=only("conical")), BOX)
    x, y, z = points.xyz_mm.T / 1000
    inside = (abs(x) < 1.001) & (abs(y) < 1.001) & (z < 29.99)
    # 18 degrees off nadir and more: at most 2.83 m / tan(18) = 8.7 m down
    assert inside.sum() > 20
    assert z[inside].min() > 30 - 2 * np.sqrt(2) / np.tan(np.radians(18))
    assert (points.building[inside] >= 0).all()


def digest(points):
    h = hashlib.sha256()
    for column in points:
        h.update(np.ascontiguousarray(column).tobytes())
    return h.hexdigest()


@pytest.mark.parametrize("preset", ["none", "paper", "hd"])
def test_points_do_not_depend_on_chunks_or_threads(preset):
    changes = {"density_per_m2": 8, "density_bounds_per_m2": (8, 8)}
    scene, strips = surface(TOWN), plan_strips(preset, **changes)
    first, counts = cast(scene, strips, BOX)
    for threads, chunk in ((1, 1000), (2, 5000), (3, 100_000)):
        again, same = cast(scene, strips, BOX, threads, chunk)
        assert digest(again) == digest(first) and same == counts


GOLDEN = {
    "none": "295c364aeba0e595ac43024e12155881a857cf15e93dacf44546cba7d5e0ed75",
    "paper": "d6fb3ec81dc2fd77e96f4d7454f006a6f59a519f71fda6acb096a439e68f6169",
    "hd": "6a63ddbe8ea9867058b4a46081c8671969d65efe54fe3301851c6b816b25d89d",
}


@pytest.mark.parametrize("preset", GOLDEN)
def test_points_are_the_same_on_every_machine(preset):
    strips = plan_strips(preset, density_per_m2=4, density_bounds_per_m2=(4, 4))
    assert digest(cast(surface(TOWN), strips, BOX)[0]) == GOLDEN[preset]


def test_noise_has_the_planned_size():
    scene, strips = surface([]), plan_strips("paper")
    exact = [replace(s, errors=s.errors._replace(noise_xy_m=0.0, noise_z_m=0.0)) for s in strips]
    wide = BOX._replace(x_min_m=-35.0, x_max_m=35.0, y_min_m=-35.0, y_max_m=35.0)
    noisy, clean = cast(scene, strips, wide)[0], cast(scene, exact, wide)[0]
    key = [p.strip.astype(np.int64) << 40 | p.pulse for p in (noisy, clean)]
    _, i, j = np.intersect1d(*key, return_indices=True)
    assert len(i) > 50_000
    delta = (noisy.xyz_mm[i] - clean.xyz_mm[j]) / 1000
    np.testing.assert_allclose(delta.std(axis=0), [0.13, 0.13, 0.05], rtol=0.02)
    np.testing.assert_allclose(delta.mean(axis=0), 0, atol=2e-3)
    assert abs(np.corrcoef(delta.T) - np.eye(3)).max() < 0.02


def test_hd_noise_is_small_on_planes_and_strips_are_shifted():
    strips = plan_strips("hd", divergence_mrad=(0.3, 0.3), strip_offset_z_m=0.5, cross_strip_share=1)
    points, _ = cast(surface([]), strips, BOX)
    numbers = np.unique(points.strip)
    assert len(numbers) >= 2
    for number in numbers:
        strip = strips[number]
        z = points.xyz_mm[points.strip == number, 2] / 1000
        assert z.mean() == pytest.approx(strip.errors.offset_z_m, abs=0.005)
        # the footprint of 30 cm averages out on a plane: only the ranging noise is left
        assert 0.012 < z.std() < 0.035
    assert len({strips[number].errors.offset_z_m for number in numbers}) == len(numbers)


def test_dark_roofs_lose_points_and_grazing_walls_more_than_roofs():
    tower = [block(-15, -15, 15, 15, 30)]
    strips = plan_strips("hd", cross_strip_share=0)
    bright, dark = (cast(surface(tower, loss), strips, BOX)[0] for loss in (0.0, 0.6))
    share = (dark.building == 0).sum() / (bright.building == 0).sum()
    assert share == pytest.approx(0.4, abs=0.03)
    none = [replace(s, errors=s.errors._replace(min_intensity=0.0, base_loss=0.0)) for s in strips]
    everything = cast(surface(tower), none, BOX)[0]
    detected_share = {
        kind: ((bright.face & 3 == kind) & (bright.building == 0)).sum()
        / ((everything.face & 3 == kind) & (everything.building == 0)).sum()
        for kind in (ROOF, WALL)
    }
    assert detected_share[WALL] < detected_share[ROOF]
    assert detected_share[ROOF] > 0.98


def test_scan_angle_and_intensity():
    points, _ = cast(surface([]), plan_strips("none", pattern_shares=only("parallel")), BOX)
    degrees = points.scan_angle * 0.006
    assert 0 < np.ptp(degrees) < 61 and np.abs(degrees).max() < 30.1
    strips = plan_strips("none", pattern_shares=only("parallel"))
    for number, strip in enumerate(strips):
        of_strip = points.strip == number
        right = np.array([np.sin(strip.path.heading_rad), -np.cos(strip.path.heading_rad)])
        across = (points.xyz_mm[of_strip, :2] / 1000 - [strip.path.start_x_m, strip.path.start_y_m]) @ right
        np.testing.assert_allclose(
            np.degrees(np.arctan2(across, strip.path.altitude_m)), degrees[of_strip], atol=0.005
        )
    assert points.intensity.min() > 0


def test_a_miss_is_a_miss():
    caster = Caster(surface([block(0, 0, 1, 1, 5)]))
    origin = np.array([[0.6, 0.5, 9], [2, 2, 9]], np.float32)
    triangle = caster.first_triangles(origin, np.array([[0, 0, -1]] * 2, np.float32))
    assert triangle[0] in (0, 1) and triangle[1] == -1
    assert Caster(surface([])).first_triangles(origin, origin).tolist() == [-1, -1]

"""Compile all code that ``p2wss reconstruct`` calls, by reconstructing three small synthetic buildings."""

import logging
from collections.abc import Callable, Sequence
from importlib.util import find_spec

import numpy as np
import pyproj
import shapely

from p2wss.clouds.reading import Cloud
from p2wss.config import Reconstruct, Scenes
from p2wss.data.building import Building
from p2wss.data.terrain import Terrain
from p2wss.fit import fitting
from p2wss.fit.planes.costs import Costs, problem_of
from p2wss.fit.planes.labelling import least_cost
from p2wss.fit.settings import PlanePrices
from p2wss.footprints.cleaning import clean_footprints
from p2wss.mesh.mesh import Mesh
from p2wss.mesh.planar import with_exact_faces
from p2wss.mesh.surface import topmost
from p2wss.reconstruction.outputs import exports
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.product import with_supposed_roofs
from p2wss.reconstruction.registration.shifts import solve_shift
from p2wss.reconstruction.running.processes import Shared
from p2wss.skeleton import build
from p2wss.skeleton.types import Polygons
from p2wss.storage.features import Features
from p2wss.storage.messages import log

_POINTS_PER_M2 = 6.0
_CRS = "EPSG:2154"


def warm_product(num_processes: int = 0, more: Sequence[Callable[[], None]] = ()) -> None:
    """Compile the code for roofs of planes, for the paper's buildings, for terrain, and if torch is installed, for the
    input of a network; and call ``more``.

    As that is slow, ``num_processes`` processes share independent parts; each loads what another one has compiled. With
    0, this process compiles all.
    """
    parts = [_fit, _parametric, _labelling, _whole, *more]
    for _ in Shared(_quietly, list(enumerate(parts)), num_processes):
        pass


def _quietly(part: tuple[int, Callable[[], None]]) -> None:
    number, function = part
    level = log.level
    # only the first part logs, which tells the progress of all
    log.setLevel(logging.WARNING if number else level)
    try:
        function()
    finally:
        log.setLevel(level)


def _fit() -> None:
    # with all points of the house, and with few
    features, cloud = _drawn()
    house = features.geometry[1]
    ring, is_within = shapely.get_coordinates(house)[:-1], shapely.contains_xy(house, cloud.x_m, cloud.y_m)
    point_m = np.column_stack([cloud.x_m, cloud.y_m, cloud.z_m])[is_within]
    for some in (point_m, point_m[::8], point_m[::60]):
        building = Building("b", "sample", (0.0, 0.0), [ring], some, np.full(len(some), 6, np.uint8), 0.0)
        fitting.fit(with_supposed_roofs([building]), Reconstruct(detail="high"))


def _parametric() -> None:
    ring = np.array([[0.0, 0.0], [8.03, 0.0], [8.03, 8.0], [0.0, 8.0]])
    mesh = Mesh.of_kernel(build(Polygons.from_rings([[ring]]), np.full(4, 45.0), np.full(1, 3.0)), 0)
    # not quite planar, and with a short ridge
    away_m = np.random.default_rng(0).uniform(0, 1e-4, mesh.vertex_m.shape) * [0, 0, 1]
    with_exact_faces(mesh.moved(mesh.vertex_m + away_m * (mesh.vertex_m[:, 2:] > 1)))


def _labelling() -> None:
    pair, one = np.zeros((1, 2), np.int64), np.zeros(1)
    problem = problem_of(
        np.arange(2), pair[0, :1], one, pair, pair[0, :1], one, np.zeros((1, 2, 2)), np.zeros((1, 3)), one > 0
    )
    costs = Costs(problem, PlanePrices(), np.zeros((1, 2)))
    least_cost(costs)
    # code that is needed only for roofs with four walls at one place, or with open ground within
    costs.total_m3(costs.faces(pair[0, :1]))
    costs.change_m3(pair[0, :1], 0, 0)


def _whole() -> None:
    features, cloud = sample()
    config = Reconstruct(detail="high")
    results = run(features, cloud, None, "sample", config)
    run(features, cloud, None, "sample", config.model_copy(update={"roofs": "parametric"}))
    topmost(np.zeros((1, 3, 3)), np.zeros((1, 3)))
    # code that is needed only for footprints that may have to move
    solve_shift(np.array([[0.0, 0.0, 1.0, 0.0]]), np.zeros(1), np.ones(1), np.zeros(2))
    terrain = Terrain(np.random.default_rng(0).uniform(0, 1, (160, 240)).astype(np.float32), -60.0, 90.0, 1.0)
    exports.with_terrain([exports.mesh(result, config) for result in results], terrain, config)
    assert pyproj.CRS(_CRS) == cloud.crs and all(result.status == "ok" for result in results)
    if find_spec("torch") is not None:
        from p2wss.nets.batch import thin

        thin(3, 2)


def sample() -> tuple[Features, Cloud]:
    """(clean footprints, their points and ground at 0 m) of a house with a lower annex, a house with a dormer and a
    flat block around a courtyard."""
    features, cloud = _drawn()
    return clean_footprints(features, Scenes()), cloud


def _drawn() -> tuple[Features, Cloud]:
    draw = np.random.default_rng(0)
    house, dormer = shapely.box(0, 0, 13, 8), shapely.box(30, 0, 42, 9)
    block = shapely.box(60, 0, 84, 20) - shapely.box(68, 7, 76, 13)
    points, classes = [], []
    for polygon in (house, dormer, block):
        x_min, y_min, x_max, y_max = polygon.buffer(1.0).bounds
        count = int(_POINTS_PER_M2 * (x_max - x_min) * (y_max - y_min))
        x, y = draw.uniform(x_min, x_max, count), draw.uniform(y_min, y_max, count)
        inside = shapely.contains_xy(polygon, x, y)
        if polygon is house:
            z = np.where(x < 9, 6.0 + 0.84 * np.minimum(y, 8 - y), 3.0)
        elif polygon is dormer:
            z = 6.0 + 0.7 * np.minimum(y, 9 - y)
            z[(x > 34) & (x < 37) & (y > 0.5) & (y < 3.5)] = 9.0
        else:
            z = np.full(count, 7.0)
        z += 0.02 * draw.standard_normal(count)
        points.append(np.column_stack([x, y, np.where(inside, z, 0.0)]))
        classes.append(np.where(inside, 6, 2).astype(np.uint8))
    shapes, ids = (np.array(each, object) for each in ([house, dormer, block], ["a", "b", "c"]))
    features = Features(shapes, {"building_id": ids}, pyproj.CRS(_CRS))
    x, y, z = np.ascontiguousarray(np.concatenate(points).T)
    return features, Cloud(x, y, z, np.concatenate(classes), features.crs)

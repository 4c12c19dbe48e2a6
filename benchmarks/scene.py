"""Whether reconstructed buildings fit together in one scene: party walls without slits and overlaps.

Usage::

    python benchmarks/scene.py --data ../shared/data                         # with the network that comes with p2wss
    .. --model none                                                          # only fitted

Needs data that are not part of the project.

``--data`` holds ``delft_ahn3`` (74 row houses) and ``olemps_bdtopo`` (2,273 footprints of a village). Every measure
takes the same scene and adds its figures; :data:`MEASURES` lists the measures. Party walls are measured in the same way
in the input and in the output.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import manifold3d
import numpy as np
import shapely
import skins
from figures import Figures, cpu_seconds

from p2wss.clouds import reading as clouds
from p2wss.config import Config
from p2wss.data.building import Reconstruction
from p2wss.footprints import cleaning as footprints
from p2wss.nets.weights_file import weights_to_use
from p2wss.reconstruction.area import footprint_settings, window
from p2wss.reconstruction.pipeline import run
from p2wss.reconstruction.registration.register import register
from p2wss.skeleton import FaceKind

# walls at most this far apart are one wall
TOUCH_M = 1e-4
# a gap up to this width is a slit if it is longer than SLIT_LENGTH_M: walls that meet in a corner are close, too
SLIT_M, SLIT_LENGTH_M = 0.05, 0.15


@dataclass(frozen=True)
class Scene:
    """Footprints and the buildings on them, in the same order.

    source, ground: object arrays of polygons, the input footprints and the outlines of the meshes on the ground.
    pairs: int (k, 2), footprints at most 0.5 m apart. reconstructions: the buildings. data: folder of the data.
    """

    source: np.ndarray
    ground: np.ndarray
    pairs: np.ndarray
    reconstructions: list[Reconstruction]
    data: Path


def read(data: Path, model: Path | None) -> Scene:
    """The scene that ``p2wss reconstruct`` makes of Delft with its defaults."""
    config, folder = Config(), data / "delft_ahn3"
    features = footprints.read_footprints(folder / "footprints.gpkg", needs_crs=False)
    cleaned = footprints.clean_footprints(features, footprint_settings(config))
    cloud = clouds.read_clouds([folder / "ahn3.laz"], window(cleaned))
    weights, predictor = weights_to_use(model), None
    if weights is not None:
        from p2wss.nets.predictor import load_predictor

        predictor = load_predictor(weights)
    if config.reconstruct.registration != "never":
        cleaned, _ = register(cleaned, cloud)
    results = run(cleaned, cloud, predictor, "delft", config.reconstruct)
    rows = [result.reconstruction for result in results]
    source = footprints.split_parts(features, config.scenes.min_area_m2).geometry
    first, second = shapely.STRtree(source).query(source, predicate="dwithin", distance=0.5)
    pairs = np.column_stack([first, second])[first < second]
    return Scene(source, np.array([outline(row) for row in rows], object), pairs, rows, data)


def outline(row: Reconstruction) -> shapely.Geometry:
    """The polygon of a building's ground faces in the CRS."""
    mesh = row.placed_mesh
    corner = mesh.vertex_m[:, :2][mesh.triangle[mesh.kind == FaceKind.GROUND]]
    return shapely.union_all(shapely.polygons(corner))


def touching(shapes: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Whether the polygons of each pair touch."""
    return shapely.distance(shapes[pairs[:, 0]], shapes[pairs[:, 1]]) <= TOUCH_M


def shared_wall_m(shapes: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """The length of the wall that each pair shares."""
    first, second = shapely.boundary(shapes[pairs[:, 0]]), shapely.boundary(shapes[pairs[:, 1]])
    return shapely.length(shapely.intersection(first, shapely.buffer(second, TOUCH_M)))


def slit_m(shapes: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """The length of slits and thin wedges between each pair."""
    total = np.zeros(len(pairs))
    for k, (i, j) in enumerate(pairs):
        ring, other = shapely.boundary(shapes[i]), shapes[j]
        near = ring.intersection(other.buffer(SLIT_M)).difference(other.buffer(TOUCH_M))
        for edge in shapely.get_parts(shapely.line_merge(near)):
            corner = shapely.get_coordinates(edge)
            length = np.hypot(*np.diff(corner, axis=0).T)
            total[k] += length[length > SLIT_LENGTH_M].sum()
    return total


def measure_walls(scene: Scene, figures: Figures) -> None:
    """Pairs that touch, walls that they share, and slits between them."""
    before, after = touching(scene.source, scene.pairs), touching(scene.ground, scene.pairs)
    figures.row("input", {"pairs": len(before), "touching": int(before.sum())})
    figures.at_least("pairs that touch as in the input", int((before & after).sum()), int(before.sum()))
    wall_m = shared_wall_m(scene.source, scene.pairs)
    length = np.minimum(shared_wall_m(scene.ground, scene.pairs), wall_m).sum()
    figures.row("shared wall in metres", {"input": wall_m.sum(), "output": length})
    figures.at_least("share of the input's shared wall", length / wall_m.sum(), 0.95)
    before, after = slit_m(scene.source, scene.pairs) > 0, slit_m(scene.ground, scene.pairs) > 0
    figures.row("pairs with slits", {"input": int(before.sum()), "output": int(after.sum())})
    figures.at_most("pairs with slits that the input does not have", int((after & ~before).sum()), 0)


def measure_overlap(scene: Scene, figures: Figures) -> None:
    """Volume that two buildings share, and walls that leave their footprint."""
    solids = []
    origin = np.array([*np.floor(shapely.bounds(scene.source[0])[:2]), 0.0])
    for row in scene.reconstructions:
        mesh = row.placed_mesh
        solids.append(
            manifold3d.Manifold(manifold3d.Mesh64(mesh.vertex_m - origin, mesh.triangle.astype(np.uint64)))
        )
    volume = [(solids[i] ^ solids[j]).volume() for i, j in scene.pairs.tolist()]
    figures.row("overlap", {"pairs above 1 litre": int((np.array(volume) > 1e-3).sum())})
    figures.at_most("overlap in m3", float(np.sum(volume)), 0.05)
    # walls leave out open ground that the points show in a footprint
    whole = [
        row for row, ground in zip(scene.reconstructions, scene.ground, strict=True) if is_whole(row, ground)
    ]
    figures.row("without open ground", {"buildings": len(whole), "of": len(scene.reconstructions)})
    off = [off_walls_m(row) for row in whole]
    figures.at_most("distance of walls from their footprint in mm", 1e3 * max(off), 0.1)
    figures.at_most(
        "corners that are not those of the footprint to the bit", sum(map(other_corners, whole)), 0
    )


def is_whole(row: Reconstruction, ground: shapely.Geometry) -> bool:
    """Whether the floor covers the footprint, up to a thousandth of its area."""
    return bool(shapely.area(ground) > 0.999 * shapely.Polygon(row.rings[0], row.rings[1:]).area)


def off_walls_m(row: Reconstruction) -> float:
    """The largest distance of the mesh's outline from the footprint, and of the footprint from it."""
    footprint = shapely.boundary(shapely.Polygon(row.rings[0], row.rings[1:]))
    assert row.mesh is not None
    corner = row.mesh.vertex_m[:, :2][row.mesh.triangle[row.mesh.kind == FaceKind.GROUND]]
    ground = shapely.boundary(shapely.union_all(shapely.polygons(corner)))
    return float(shapely.hausdorff_distance(footprint, ground, densify=0.1))


def other_corners(row: Reconstruction) -> int:
    """Number of corners of the footprint at which the mesh has no vertex, without corners on straight edges."""
    assert row.mesh is not None
    present, result = set(map(tuple, row.mesh.vertex_m[:, :2].tolist())), 0
    for ring in row.rings:
        for before, corner, after in zip(
            np.roll(ring, 1, axis=0), ring, np.roll(ring, -1, axis=0), strict=True
        ):
            off_m = shapely.distance(shapely.Point(corner), shapely.LineString([before, after]))
            result += tuple(corner.tolist()) not in present and bool(off_m > TOUCH_M)
    return result


def measure_cleaning(scene: Scene, figures: Figures) -> None:
    """CPU time of cleaning the footprints of a village."""
    path = scene.data / "olemps_bdtopo" / "BATIMENT.shp"
    if not path.exists():
        return
    features, settings = footprints.read_footprints(path), footprint_settings(Config())
    seconds = cpu_seconds(lambda: footprints.clean_footprints(features, settings))
    figures.at_most("cleaning, ms per footprint of Olemps", 1e3 * seconds / len(features), 1.0)
    largest = features.take(np.array([shapely.get_num_coordinates(features.geometry).argmax()]))
    # with a neighbour along its north side, so that it is cleaned as part of a coverage
    x_min, _, x_max, y_max = shapely.total_bounds(largest.geometry)
    (shape,) = largest.geometry
    beside = shapely.box(x_min, y_max - 5, x_max, y_max + 5).difference(shape)
    both = np.array([shape, max(shapely.get_parts(beside), key=shapely.area)])
    pair = replace(features.take(np.arange(2)), geometry=both)
    seconds = cpu_seconds(lambda: footprints.clean_footprints(pair, settings))
    figures.row("largest footprint of Olemps", {"vertices": len(shape.exterior.coords), "ms": 1e3 * seconds})


def measure_skin(scene: Scene, figures: Figures) -> None:
    """The skins of blocks of touching buildings."""
    skins.measure_skins(scene.reconstructions, figures)


MEASURES: tuple[Callable[[Scene, Figures], None], ...] = (
    measure_walls,
    measure_overlap,
    measure_cleaning,
    measure_skin,
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, default=None, help="weights of a network, or none")
    arguments = parser.parse_args()
    scene, figures = read(arguments.data, arguments.model), Figures()
    for measure in MEASURES:
        measure(scene, figures)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())

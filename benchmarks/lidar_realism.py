"""Figures that compare simulated LiDAR with real LiDAR, measured in the same way on both. Used by lidar.py."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path

import geopandas as gpd
import laspy
import numpy as np
import shapely
from lidar_scene import NO_CLUTTER, TILE, as_cloud, footprints, make_buildings, make_terrain
from lidar_twins import simulate_again, wall_depths_m
from scipy.spatial import cKDTree

from p2wss.clouds.crops import crop_cloud
from p2wss.clouds.reading import Cloud, read_clouds
from p2wss.config import Clutter, Scans
from p2wss.data import polygon_arrays
from p2wss.data.las_classes import VEGETATION_CLASS
from p2wss.scans import scan as scans

_REAL = (("Delft AHN3", "delft_ahn3", "ahn3.laz", 28992), ("Bresse IGN", "bresse_ign", "lidar.laz", 2154))


@dataclass(frozen=True)
class Realism:
    """Figures of one cloud; NaN where it has no footprints or returns to measure.

    density_*: points per m2 in cells of 2 m that contain any, mean and percentiles. spacing_m: median
    distance in plan to the nearest point. wall_share: wall points over wall and roof points; a wall point is
    within 0.5 m of a footprint's edge, at least 1 m above the ground and 0.7 m below the eaves, which are the
    5th percentile of the roof's points. walls_seen: edges with 10 of them, per building. roof_noise_m: median
    standard deviation about a plane through the 15 nearest roof points. vegetation_share: points of class 5.
    returns: per pulse, on average over the points.
    """

    density_mean: float
    density_p5: float
    density_p95: float
    spacing_m: float
    wall_share: float
    walls_seen: float
    roof_noise_m: float
    vegetation_share: float
    returns: float

    def as_json(self) -> dict[str, float | None]:
        """The figures by name, None for NaN."""
        return {name: None if np.isnan(value) else round(value, 4) for name, value in asdict(self).items()}


def print_table(rows: dict[str, Realism]) -> None:
    """One line per cloud."""
    names = [field.name for field in fields(Realism)]
    print(f"\n{'realism':<34}" + "".join(f"{name:>17}" for name in names))
    for name, row in rows.items():
        print(f"{name:<34}" + "".join(f"{value:>17.3f}" for value in astuple(row)))


def measure(cloud: Cloud, shapes: np.ndarray, num_returns: np.ndarray | None = None) -> Realism:
    """The figures of a cloud and the footprints in it; ``num_returns`` of the pulse of each point, None: one."""
    xy = np.stack([cloud.x_m, cloud.y_m], 1)
    _, counts = np.unique((xy // 2).astype(np.int64), axis=0, return_counts=True)
    density = counts / 4
    rng = np.random.default_rng(0)
    sample = rng.choice(len(cloud), min(len(cloud), 20_000), replace=False)
    distance, _ = cKDTree(xy).query(xy[sample], 2)
    wall_share, walls_seen, roof_noise_m = _walls_and_roofs(cloud, shapes, rng)
    return Realism(
        density_mean=float(density.mean()),
        density_p5=float(np.percentile(density, 5)),
        density_p95=float(np.percentile(density, 95)),
        spacing_m=float(np.median(distance[:, 1])),
        wall_share=wall_share,
        walls_seen=walls_seen,
        roof_noise_m=roof_noise_m,
        vegetation_share=float((cloud.classification == VEGETATION_CLASS).mean()),
        returns=float(num_returns.mean()) if num_returns is not None else 1.0,
    )


def _walls_and_roofs(
    cloud: Cloud, shapes: np.ndarray, rng: np.random.Generator
) -> tuple[float, float, float]:
    """wall_share, walls_seen and roof_noise_m of :class:`Realism`."""
    if not len(shapes):
        return np.nan, np.nan, np.nan
    cropped = crop_cloud(cloud, polygon_arrays.to_polygons(shapes), 0.5)
    num_wall_points, num_roof_points = 0, 0
    walls_seen: list[int] = []
    noise: list[float] = []
    for row, shape in enumerate(shapes):
        index = cropped.of(row)
        inside = cropped.inside[cropped.offset[row] : cropped.offset[row + 1]]
        above = cloud.z_m[index] - cropped.ground_z_m[row]
        is_solid = cloud.classification[index] != VEGETATION_CLASS
        on_roof = inside & (above > 2) & is_solid
        if on_roof.sum() < 50 or not np.isfinite(cropped.ground_z_m[row]):
            continue
        eave = np.percentile(above[on_roof], 5)
        x, y = cloud.x_m[index], cloud.y_m[index]
        ring = np.asarray(shape.exterior.coords)[:, :2]
        edges = np.asarray(shapely.linestrings(np.stack([ring[:-1], ring[1:]], 1)))
        below = np.flatnonzero((above > 1) & (above < eave - 0.7) & is_solid)
        away = np.ones((0, len(edges)))
        if len(below):
            away = shapely.distance(shapely.points(x[below], y[below])[:, None], edges[None, :])
        is_wall = away.min(axis=1, initial=np.inf) < 0.5
        nearest_edge = away[is_wall].argmin(axis=1)
        num_wall_points += int(is_wall.sum())
        num_roof_points += int((inside & (above >= eave)).sum())
        walls_seen.append(int((np.bincount(nearest_edge, minlength=1) >= 10).sum()))
        core = np.flatnonzero(on_roof & (above > eave))
        roof = np.stack([x[core], y[core], above[core]], 1)
        noise += _plane_residuals(roof[rng.choice(len(roof), min(len(roof), 300), replace=False)])
    if not walls_seen:
        return np.nan, np.nan, np.nan
    share = num_wall_points / max(num_wall_points + num_roof_points, 1)
    return share, float(np.mean(walls_seen)), float(np.median(noise)) if noise else np.nan


def _plane_residuals(xyz: np.ndarray) -> list[float]:
    """Standard deviation about a plane through the 15 nearest points, for the flatter half of the places."""
    if len(xyz) < 30:
        return []
    _, index = cKDTree(xyz[:, :2]).query(xyz[:, :2], 15)
    near = xyz[index] - xyz[index].mean(axis=1, keepdims=True)
    smallest = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", near, near))[:, 0]
    sigma = np.sqrt(np.maximum(smallest, 0) / (15 - 3))
    return np.sort(sigma)[: len(sigma) // 2].tolist()


def real_clouds(data: Path) -> dict[str, Realism]:
    """The figures of the real clouds in ``data``, and of the same places simulated; absent ones are skipped."""
    rows = {}
    for name, folder, file, crs in _REAL:
        path = data / folder / file
        if not path.exists():
            print(f"  {name}: no {path}, skipped")
            continue
        frame = gpd.read_file(data / folder / "footprints.gpkg")
        frame = frame.set_crs(crs, allow_override=True) if frame.crs is None else frame
        frame = frame.assign(geometry=shapely.force_2d(frame.geometry.to_numpy())).explode(index_parts=False)
        cloud, shapes = read_clouds([path]), frame.geometry.to_numpy()
        twin = simulate_again(path, data / folder / "dtm.asc", cloud, shapes, Clutter())
        name = f"{name}, {twin.mean_angle_deg:.0f} deg"
        rows[name] = measure(cloud, shapes, _num_returns(path))
        rows[f"{name}, simulated"] = measure(twin.cloud, shapes)
        depth = np.percentile(wall_depths_m(cloud, shapes), [10, 50, 90])
        print(
            f"  {name}: points below the eaves are {depth[0]:.2f} to {depth[2]:.2f} m inside the footprint, "
            f"{depth[1]:.2f} m in the median"
        )
    for path in sorted((data / "lidarhd_crops").glob("*_IGN69.laz")):
        no_footprints = np.array([], dtype=object)
        rows[f"LiDAR HD {path.name[:12]}"] = measure(read_clouds([path]), no_footprints, _num_returns(path))
    return rows


def _num_returns(path: Path) -> np.ndarray:
    """Number of returns of the pulse of each point of a file."""
    return np.asarray(laspy.read(path).num_returns)


def simulated_clouds(size_m: float) -> dict[str, Realism]:
    """The figures of each preset, ``hd`` on several surveys, with the density of the preset."""
    buildings, terrain = make_buildings(int(0.0025 * size_m**2), size_m), make_terrain(size_m)
    shapes = polygon_arrays.to_geometries(footprints(buildings))
    cases = {
        "none": Scans(preset="none", density_per_m2=None),
        "paper": Scans(preset="paper", density_per_m2=None),
        "hd, no clutter": Scans(density_per_m2=None, clutter=NO_CLUTTER),
        **{f"hd, survey {seed}": Scans(density_per_m2=None, seed=seed) for seed in range(4)},
    }
    rows = {}
    for name, config in cases.items():
        scan = scans.simulate(buildings, terrain, TILE, size_m, config)
        cloud, _, _ = as_cloud(scan)
        pattern = scan.facts["survey"]["pattern"]
        rows[f"{name} ({pattern})"] = measure(cloud, shapes)
    return rows

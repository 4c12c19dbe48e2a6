"""Whether files are as exact as a radar simulator needs: folds, walls, wedges, slivers; the last line is JSON.

    python benchmarks/exact.py [--data ../shared/data] [--keep FOLDER]

Reconstructs Delft west, five large blocks of LiDAR HD (both with data that are not part of the project) and the
miniature, by default, with ``--skin --wedges`` and with ``--detail high``, as a user does, and measures the files:
CityJSON for faces and validity, OBJ for triangles, the table of wedges. ``--keep``: files that are there already are
measured again. Only whether solids are valid is decided by code of the package.

* A *fold* is an edge whose triangles turn by 0.1 to 5 degrees. A fold of a skin counts if the separate buildings have
  none at its place, or above it where a floor was lowered with its walls. Between two buildings a fold may be true, as
  the slopes of neighbours may differ by so little.
* Deviations explained by coordinates in hundredths of a millimetre are neither folds nor tilts nor wrong angles.
* A wall is *along the footprint* if it is turned by less than 0.1 degrees from an edge of the input beside it; walls
  away from the footprint do not count.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from figures import Figures
from real_places import places
from scipy.spatial import cKDTree

from p2wss.mesh.faces import Surface
from p2wss.mesh.rules import Tolerances, breaches

# in comments of an OBJ file, the surface and its building
SURFACES = ("wall", "roof", "ground", "outer_floor")
ROOT = Path(__file__).resolve().parents[1]
VARIANTS = {"default": [], "--skin": ["--skin", "--wedges"], "detail: high": ["--detail", "high"]}
# tolerances of solids, stricter than the defaults of val3dity
STRICT = Tolerances(snap_m=1e-2, planar_m=1e-3, fold_deg=1.0)
FOLD_DEG, TILT_DEG, ANGLE_DEG, ALONG_DEG, WEDGE_DEG = (0.1, 5.0), 0.01, 0.05, 0.1, 1.0
# distance by which the rounding of coordinates may move a surface; distance at which two points or edges count as one
ROUNDED_M, SAME_M = 2e-5, 3e-3
# roofs are less steep than this; one of Delft has 79 degrees
STEEPEST_ROOF_NZ = 0.05
# a wall's middle is nearer than this to the edge of the footprint beside it
BESIDE_M = 0.5
# a skin's floors are lowered by at most this
LOWERED_M = 0.5


@dataclass(frozen=True)
class Edges:
    """The edges of a mesh between two triangles. end_m: (e, 2, 3). turn_deg: (e,), positive at convex edges. blur_deg:
    (e,), by how much the rounding of coordinates may change turn_deg. is_between: (e,), whether an edge lies between
    two buildings."""

    end_m: np.ndarray
    turn_deg: np.ndarray
    blur_deg: np.ndarray
    is_between: np.ndarray

    @property
    def folds(self) -> np.ndarray:
        """bool (e,): which edges are folds."""
        turn_deg = np.abs(self.turn_deg)
        return (turn_deg > np.maximum(FOLD_DEG[0], self.blur_deg)) & (turn_deg < FOLD_DEG[1])


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(vertices (v, 3), triangles (t, 3), the building of each) of an OBJ file."""
    vertices, triangles, building, names, number = [], [], [], dict[str, int](), 0
    for line in path.read_text(encoding="utf-8").splitlines():
        word, *rest = line.split()
        if word == "v":
            vertices.append([float(value) for value in rest])
        elif word == "f":
            triangles.append([int(value) - 1 for value in rest])
            building.append(number)
        elif word == "#" and len(rest) == 2 and rest[0] in SURFACES:
            number = names.setdefault(rest[-1], len(names))
    return np.array(vertices), np.array(triangles), np.array(building)


def edges_of(vertex_m: np.ndarray, triangle: np.ndarray, building: np.ndarray) -> Edges:
    """The edges of a closed mesh."""
    start, end = triangle.ravel(), np.roll(triangle, -1, axis=1).ravel()
    half = {edge: k // 3 for k, edge in enumerate(zip(start.tolist(), end.tolist(), strict=True))}
    rows = [(a, b, t, half[b, a]) for (a, b), t in half.items() if a < b and (b, a) in half]
    start, end, left, right = np.array(rows).T
    corner = vertex_m[triangle]
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    twice_m2 = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(twice_m2, 1e-12)[:, None]
    along = vertex_m[end] - vertex_m[start]
    length_m = np.linalg.norm(along, axis=1)
    sine = (np.cross(normal[left], normal[right]) * along).sum(axis=1) / length_m
    turn_deg = np.degrees(np.arctan2(sine, (normal[left] * normal[right]).sum(axis=1)))
    # largest turn of a triangle by a corner that moves, from its least height
    side_m = np.linalg.norm(corner - np.roll(corner, -1, axis=1), axis=2)
    blurred_deg = np.degrees(np.arctan2(ROUNDED_M, twice_m2 / side_m.max(axis=1)))
    return Edges(
        vertex_m[np.column_stack([start, end])],
        turn_deg,
        blurred_deg[left] + blurred_deg[right],
        building[left] != building[right],
    )


def new_folds(skin: Edges, parts: Edges) -> np.ndarray:
    """bool (e,): which edges of a skin are folds where the parts have none."""
    result = skin.folds
    rows = np.flatnonzero(result)
    # rounding decides whether an edge of the parts beside thin triangles is a fold: such edges count as folds here
    turn_deg = np.abs(parts.turn_deg)
    ends = parts.end_m[(turn_deg + parts.blur_deg > FOLD_DEG[0]) & (turn_deg - parts.blur_deg < FOLD_DEG[1])]
    lines = shapely.linestrings(ends)
    middle = skin.end_m[rows].mean(axis=1)
    place, line = shapely.STRtree(lines).query(shapely.points(middle[:, :2]), "dwithin", SAME_M)
    along = ends[line, 1] - ends[line, 0]
    share = ((middle[place] - ends[line, 0]) * along).sum(axis=1) / (along**2).sum(axis=1)
    length_m = np.linalg.norm(along, axis=1)
    more = np.where(np.hypot(*along[:, :2].T) < SAME_M, LOWERED_M / length_m, 0.0)
    foot = ends[line, 0] + np.clip(share, -more, 1 + more)[:, None] * along
    result[rows[place[np.linalg.norm(foot - middle[place], axis=1) < SAME_M]]] = False
    return result


def wrong_wedges(edges: Edges, table: pd.DataFrame, origin_m: np.ndarray) -> dict[str, int]:
    """Numbers of convex edges that the table lacks, of rows without such an edge, and of wrong angles."""
    stated = np.stack(
        [table[[f"{axis}{k}_m" for axis in "xyz"]].to_numpy() - origin_m for k in (0, 1)], axis=1
    )
    tree = cKDTree(edges.end_m.mean(axis=1))
    is_listed, extra, off = np.zeros(len(edges.end_m), bool), 0, 0
    for ends, angle_deg in zip(stated, table["opening_angle_deg"], strict=True):
        found = []
        for k in tree.query_ball_point(ends.mean(axis=0), SAME_M):
            # ends in either order; several solids may have an edge at one place
            gap_m = min(np.abs(edges.end_m[k] - ends).max(), np.abs(edges.end_m[k] - ends[::-1]).max())
            if not is_listed[k] and gap_m < ROUNDED_M:
                found.append((abs(180 - edges.turn_deg[k] - angle_deg), k))
        if not found:
            extra += 1
            continue
        error_deg, nearest = min(found)
        is_listed[nearest] = True
        off += error_deg > ANGLE_DEG + edges.blur_deg[nearest]
    is_convex = edges.turn_deg > WEDGE_DEG + edges.blur_deg
    return {"missing": int((is_convex & ~is_listed).sum()), "extra": extra, "off": int(off)}


def shells(path: Path) -> Iterator[tuple[np.ndarray, list[list[list[int]]]]]:
    """(vertices, faces as rings) of the solids of a CityJSON file."""
    document = json.loads(path.read_text(encoding="utf-8"))
    place = document["transform"]
    vertex_m = np.array(document["vertices"]) * place["scale"] + place["translate"]
    for building in document["CityObjects"].values():
        for geometry in building.get("geometry", []):
            (shell,) = geometry["boundaries"]
            yield vertex_m, shell


def measure_faces(city_json: Path, footprints: Path) -> dict[str, float]:
    """Figures of the faces of the solids in a CityJSON file."""
    frame = gpd.read_file(footprints)
    rings = shapely.get_rings(shapely.get_parts(shapely.force_2d(frame.geometry.to_numpy())))
    sides = np.concatenate(
        [np.stack([xy[:-1], xy[1:]], axis=1) for xy in map(shapely.get_coordinates, rings)]
    )
    sides = sides[np.hypot(*(sides[:, 1] - sides[:, 0]).T) > 0]
    tree = shapely.STRtree(shapely.linestrings(sides))
    direction = np.degrees(np.arctan2(*(sides[:, 1] - sides[:, 0]).T[::-1]))
    num_tilted, off_plane_m, shortest_m = 0, 0.0, np.inf
    invalid, walls = Counter[str](), []
    for vertices, shell in shells(city_json):
        surfaces = [Surface(0, -1, [np.array(ring) for ring in rings]) for rings in shell]
        invalid.update({str(breach.code) for breach in breaches(vertices, surfaces, STRICT)})
        for surface in surfaces:
            rings_m = [vertices[ring] for ring in surface.rings]
            corner = np.concatenate(rings_m)
            corner_m = corner - corner.mean(axis=0)
            area = (
                sum(np.cross(r - corner[0], np.roll(r, -1, axis=0) - corner[0]).sum(axis=0) for r in rings_m)
                / 2
            )
            off_plane_m = max(off_plane_m, np.abs(corner_m @ np.linalg.svd(corner_m)[2][2]).max())
            shortest_m = min(
                shortest_m, *(np.linalg.norm(r - np.roll(r, -1, axis=0), axis=1).min() for r in rings_m)
            )
            normal = area / np.linalg.norm(area)
            if abs(normal[2]) < STEEPEST_ROOF_NZ:
                lean = np.arcsin(abs(normal[2]))
                height_m = np.ptp(corner[:, 2])
                num_tilted += np.degrees(lean) > TILT_DEG and lean * height_m > ROUNDED_M
                walls.append(
                    [
                        *corner.mean(axis=0)[:2],
                        np.degrees(np.arctan2(normal[0], -normal[1])),
                        np.linalg.norm(area),
                    ]
                )
    wall = np.array(walls)
    place, side = tree.query(shapely.points(wall[:, :2]), "dwithin", BESIDE_M)
    turned_deg = np.abs((wall[place, 2] - direction[side] + 90) % 180 - 90)
    least_deg = np.full(len(wall), np.inf)
    np.minimum.at(least_deg, place, turned_deg)
    # other walls are between roofs
    is_outer = least_deg < 20
    area_m2 = wall[is_outer, 3]
    return {
        "tilted walls": num_tilted,
        "off the plane, mm": 1e3 * off_plane_m,
        "wall area along the footprint": area_m2[least_deg[is_outer] < ALONG_DEG].sum() / area_m2.sum(),
        "shortest edge of a face, mm": 1e3 * shortest_m,
        "invalid": invalid.total(),
    }


def measure_triangles(vertex_m: np.ndarray, triangle: np.ndarray, num_buildings: int) -> dict[str, float]:
    """Figures of the triangles of a mesh."""
    corner = vertex_m[triangle]
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    sine = np.linalg.norm(np.cross(ahead, back), axis=2)
    angle_deg = np.degrees(np.arctan2(sine, (ahead * back).sum(axis=2))).min(axis=1)
    return {
        "slivers per building": float((angle_deg < 1).sum()) / num_buildings,
        "shortest edge, mm": 1e3 * float(np.linalg.norm(ahead, axis=2).min()),
        "triangles": len(triangle),
    }


def one(folder: Path, pattern: str) -> Path:
    """The only file of a folder that matches a pattern."""
    (path,) = folder.glob(pattern)
    return path


def measure(name: str, footprints: Path, folders: dict[str, Path], figures: Figures) -> None:
    """Add the figures of all variants of a place."""
    edges, triangles = {}, 0.0
    for variant, folder in folders.items():
        vertex_m, triangle, building = read_obj(one(folder, "*.obj"))
        edges[variant] = edges_of(vertex_m, triangle, building)
        row = measure_triangles(vertex_m, triangle, building.max() + 1)
        row["folds"] = int(edges[variant].folds.sum())
        title = f"{name}, {variant}"
        if variant == "--skin":
            is_new = new_folds(edges[variant], edges["default"])
            is_between = edges[variant].is_between
            row |= {
                "new folds": int((is_new & ~is_between).sum()),
                "between buildings": int((is_new & is_between).sum()),
            }
            row["triangles per triangle of the parts"] = row["triangles"] / triangles
            table = pd.read_parquet(one(folder, "*.wedges.parquet"))
            names = [path for path in folder.glob("*.json") if ".city." not in path.name]
            origin_m = np.array(json.loads(names[0].read_text())["origin_m"])
            row |= {
                f"wedges {key}": value for key, value in wrong_wedges(edges[variant], table, origin_m).items()
            }
            figures.at_most(f"{title}, new folds", row["new folds"], 0)
            figures.at_most(f"{title}, folds per building", row["folds"] / (building.max() + 1), 0.35)
            figures.at_most(f"{title}, triangles", row["triangles per triangle of the parts"], 1.05)
            figures.at_most(
                f"{title}, wrong wedges", sum(row[f"wedges {k}"] for k in ("missing", "extra", "off")), 0
            )
        else:
            triangles = row["triangles"]
            row |= measure_faces(one(folder, "*.city.json"), footprints)
            for key, bar in (("tilted walls", 0), ("off the plane, mm", 0.01), ("invalid", 0)):
                figures.at_most(f"{title}, {key}", row[key], bar)
            figures.at_least(
                f"{title}, wall area along the footprint", row["wall area along the footprint"], 0.92
            )
        figures.at_most(f"{title}, slivers per building", row["slivers per building"], 0.03)
        figures.at_least(f"{title}, shortest edge, mm", row["shortest edge, mm"], 50)
        figures.row(title, {key: round(float(value), 4) for key, value in row.items()})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--keep", type=Path, help="folder for the files that are measured")
    arguments = parser.parse_args()
    figures = Figures()
    mini = ROOT / "tests" / "mini"
    inputs = {
        name: (place.footprints, place.clouds)
        for name, place in places(arguments.data).items()
        if name != "bresse"
    }
    inputs["miniature"] = (mini / "bdtopo" / "BDTOPO_mini.gpkg", tuple((mini / "lidar").glob("*.laz")))
    with tempfile.TemporaryDirectory() as scratch:
        for name, (footprints, clouds) in inputs.items():
            folders = {}
            for number, (variant, options) in enumerate(VARIANTS.items()):
                folders[variant] = folder = (arguments.keep or Path(scratch)) / name / str(number)
                if not folder.exists():
                    command = [
                        "p2wss",
                        "reconstruct",
                        *clouds,
                        footprints,
                        folder,
                        "--format",
                        "cityjson,obj",
                        *options,
                    ]
                    subprocess.run([str(word) for word in command], check=True, stderr=subprocess.PIPE)
            measure(name, footprints, folders, figures)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())

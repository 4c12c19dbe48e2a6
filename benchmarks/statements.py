"""Whether files that state their CRS and units in many ways are read right: 5,000 drawn combinations of statements.

    python benchmarks/statements.py [--num 5000] [--whole 30] [--seed 0]

Needs nothing but the package and the control houses of `tests/unit/control_houses.py`, whose truth is known.

Drawn are: the CRS of the cloud (metres, feet, degrees, EPSG:3857), how it is stated (WKT 1, WKT 2, GeoTIFF keys, both,
by --crs or not), the unit of heights and what states it (a tenth of the files state a wrong one), the LAS version;
format, CRS, layers, rings, ids and heights of footprints; type, scale, unit, data without heights and AREA_OR_POINT of
a terrain. Each combination is inspected as by `p2wss inspect`, and compared with the truth by pyproj. It is `right`;
`refused` in one line; `told`: wrong, but a line says what was assumed or doubted; or `silently wrong`. Some are also
reconstructed.
The last line is JSON.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
import tempfile
import time
from collections import Counter
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import shapely

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "unit"))
import control_houses as houses  # noqa: E402
from figures import Figures  # noqa: E402

import p2wss  # noqa: E402
from p2wss.config import as_config  # noqa: E402
from p2wss.reconstruction.area import read_features  # noqa: E402
from p2wss.reconstruction.inputs import check_inputs  # noqa: E402
from p2wss.reconstruction.look import look  # noqa: E402
from p2wss.storage.features import Features  # noqa: E402
from p2wss.storage.messages import InputError  # noqa: E402

PLACE, HEIGHT_M = "EPSG:26910", {"m": 1.0, "ft": houses.FOOT_M, "us-ft": houses.SURVEY_FOOT_M}
VERTICAL = {"m": "EPSG:5703", "ft": "EPSG:8228", "us-ft": "EPSG:6360"}
UNIT_CODE = {"m": 9001, "ft": 9002, "us-ft": 9003}
PLANES = ("EPSG:26910", "EPSG:2227", "EPSG:3857", "EPSG:4326")
RIGHT, REFUSED, TOLD, WRONG = "right", "refused", "told", "silently wrong"
# median over both houses
ROOF_M = 6.34
SLOPE, CELLS, CELL_M = 0.05, 40, 2.0


@dataclass(frozen=True)
class CloudCase:
    """A cloud. plane: its horizontal CRS. form: what states the CRS. unit: of heights. stated: the unit that is stated,
    "" for none. by: what states the unit."""

    plane: str
    form: str
    unit: str
    stated: str
    by: str
    version: str


@dataclass(frozen=True)
class FootprintCase:
    """A file of footprints: format, CRS, layer beside its own, whether rings are reversed, id column, whether heights
    are stated."""

    ending: str
    crs: str
    beside: str
    is_reversed: bool
    id_column: str
    has_heights: bool


@dataclass(frozen=True)
class TerrainCase:
    """A raster: type of values, their unit, what states the unit, the value of cells without data, and
    AREA_OR_POINT."""

    dtype: str
    unit: str
    by: str
    nodata: str
    is_point: bool


Case = tuple[CloudCase, FootprintCase, TerrainCase | None]


def drawn(rng: np.random.Generator) -> Case:
    """A random combination. Most state the truth; one in ten states another unit of heights."""

    def one(*values: Any) -> Any:
        return values[int(rng.integers(len(values)))]

    plane = one(*PLANES)
    form = one("wkt1", "wkt2", "keys", "both", "option", "nothing")
    unit = one("m", "m", "ft", "us-ft")
    by = one("crs", "unit key", "datum key", "option", "nothing")
    # what the user states counts, whatever it is
    stated = one("m", "ft", "us-ft") if rng.random() < 0.1 and by != "option" else unit
    cloud = CloudCase(plane, form, unit, "" if by == "nothing" else stated, by, one("1.2", "1.4"))
    ending = one("gpkg", "geojson", "shp", "fgb", "parquet")
    crs = "EPSG:4326" if ending == "geojson" else one(PLACE, "EPSG:4326", "EPSG:2227", "EPSG:3857")
    beside = one("", "before", "after") if ending == "gpkg" else ""
    ids = one("id", "osm_id", "cleabs", "")
    footprints = FootprintCase(ending, crs, beside, bool(rng.random() < 0.5), ids, bool(rng.random() < 0.5))
    if rng.random() < 0.4:
        return cloud, footprints, None
    dtype = one("float32", "float64", "int16", "uint16")
    by = one("band", "option", "nothing") if dtype.startswith("float") else one("band", "scale", "nothing")
    unit = one("m", "ft", "us-ft") if dtype.startswith("float") else one("cm", "dm")
    terrain = TerrainCase(dtype, unit, by, one("declared", "undeclared", "none"), bool(rng.random() < 0.5))
    return cloud, footprints, terrain


def terrain_m(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """The true terrain at local coordinates: a slope through the ground of the houses."""
    return houses.GROUND_M + SLOPE * (x_m - 10.0) - 0.02 * y_m


class Files:
    """The files of cases, each written once. Arguments are those of :class:`CloudCase` and so on."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.count = folder, 0
        self.cloud, self.footprints = cache(self._cloud), cache(self._footprints)
        self.terrain = cache(self._terrain)

    def _path(self, ending: str) -> Path:
        self.count += 1
        return self.folder / f"{self.count}.{ending}"

    def _cloud(self, case: CloudCase) -> Path:
        flat = pyproj.CRS(case.plane)
        in_crs = case.by == "crs" and case.stated and case.form in ("wkt1", "wkt2", "both")
        crs = flat
        if in_crs:
            heights = pyproj.CRS(VERTICAL[case.stated])
            crs = pyproj.crs.CompoundCRS(f"{flat.name} + {heights.name}", [flat, heights])
        keys: dict[int, int] = {}
        if case.form in ("keys", "both"):
            keys = {1024: 2, 2048: 4326} if flat.is_geographic else {3072: flat.to_epsg()}
        if case.by == "unit key" and case.stated:
            keys[4099] = UNIT_CODE[case.stated]
        if case.by == "datum key" and case.stated:
            keys[4096] = pyproj.CRS(VERTICAL[case.stated]).to_epsg()
        wkt = None
        if case.form in ("wkt1", "wkt2", "both"):
            wkt = crs.to_wkt("WKT1_GDAL" if case.form == "wkt1" else "WKT2_2019")
        stated = houses.header(wkt, keys or None, case.version == "1.4")
        return houses.write_cloud(self._path("las"), PLACE, flat, HEIGHT_M[case.unit], stated)

    def _footprints(self, case: FootprintCase) -> Path:
        path = self._path(case.ending)
        columns = {"height": [houses.RIDGE_M, houses.FLAT_M]} if case.has_heights else {}
        frame = houses.footprints(PLACE, case.crs, **columns)
        if case.is_reversed:
            frame.geometry = frame.geometry.reverse()
        frame = (
            frame.drop(columns="id") if not case.id_column else frame.rename(columns={"id": case.id_column})
        )
        points = frame.set_geometry(frame.geometry.representative_point())
        if case.beside == "before":
            points.to_file(path, layer="addresses")
        if case.ending == "parquet":
            frame.to_parquet(path)
        else:
            frame.to_file(path, **({"layer": "houses"} if case.ending == "gpkg" else {}))
        if case.beside == "after":
            points.to_file(path, layer="addresses")
        return path

    def _terrain(self, case: TerrainCase) -> Path:
        at = (np.arange(CELLS) + 0.5) * CELL_M - CELLS * CELL_M / 2
        values = terrain_m(at[None, :], -at[:, None])
        length_m = {**HEIGHT_M, "cm": 0.01, "dm": 0.1}[case.unit]
        values = values / length_m
        is_float = case.dtype.startswith("float")
        values = values if is_float else np.round(values)
        empty = -9999.0 if case.dtype != "uint16" else 65535.0
        if case.nodata != "none":
            values[:2] = empty
        declared = {"nodata": empty} if case.nodata == "declared" else {}
        path = houses.write_terrain(
            self._path("tif"),
            values.astype(case.dtype),
            PLACE,
            scale=length_m if case.by == "scale" else 1.0,
            unit={"us-ft": "US survey foot"}.get(case.unit, case.unit) if case.by == "band" else None,
            **declared,
        )
        if case.is_point:
            import rasterio

            with rasterio.open(path, "r+") as raster:
                raster.update_tags(AREA_OR_POINT="Point")
        return path


class Lines(logging.Handler):
    """The lines of a look that say what is assumed or doubted."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if text.startswith("warning") or "assum" in text:
            self.lines.append(text)


def options(case: Case) -> tuple[str | None, dict[str, Any]]:
    """(--crs, the settings) that the user states."""
    cloud, _, terrain = case
    settings: dict[str, Any] = {"registration": "never"}
    if cloud.by == "option" and cloud.stated:
        settings["height_unit"] = cloud.stated
    if terrain is not None and terrain.by == "option":
        settings["terrain_unit"] = terrain.unit
    return cloud.plane if cloud.form == "option" else None, settings


def looked_at(case: Case, files: Files) -> tuple[str, str]:
    """(the outcome of a case, such as :data:`RIGHT`; the reason)."""
    cloud, footprints, terrain = case
    crs, settings = options(case)
    raster = None if terrain is None else files.terrain(terrain)
    config, handler, logger = as_config({"reconstruct": settings}), Lines(), logging.getLogger("p2wss")
    logger.addHandler(handler)
    level, spread = logger.level, logger.propagate
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        inputs = check_inputs(
            files.cloud(cloud), files.footprints(footprints), config, crs, raster, model="none"
        )
        facts, problem = look(inputs, config)
        if problem:
            raise InputError(problem)
        features = read_features(inputs, config.reconstruct)
    except InputError as error:
        return (WRONG, f"not one line: {error}") if "\n" in str(error) else (REFUSED, str(error))
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
        logger.propagate = spread
    wrong = differences(inputs, facts, features, bool(footprints.id_column))
    if not wrong:
        return RIGHT, ""
    # messages about cells without data and the accuracy of PROJ do not tell about units or the place
    told = [
        line for line in handler.lines if "no ground is at" not in line and "may be displaced" not in line
    ]
    return (TOLD, told[0]) if told else (WRONG, "; ".join(wrong))


def differences(inputs: Any, facts: dict[str, Any], features: Features, has_ids: bool) -> list[str]:
    """The differences from the truth, one text each."""
    to_run = pyproj.Transformer.from_crs(PLACE, inputs.crs, always_xy=True)
    truths = dict(zip(("gable", "flat"), houses.footprints(PLACE).geometry, strict=True))
    result = []
    for name, shape in zip(features["building_id"].tolist(), features.geometry, strict=True):
        # some formats change the order of features
        candidates = [truths[name]] if name in truths else [] if has_ids else list(truths.values())
        moved = [
            shapely.transform(each, lambda xy: np.column_stack(to_run.transform(*xy.T)))
            for each in candidates
        ]
        off_m = min((shape.hausdorff_distance(each) for each in moved), default=np.inf)
        if not off_m < 0.1:
            result.append(f"footprint {name} is {off_m:.2f} m off")
    heights, points = facts["heights"], facts["points"]
    for name, truth, tolerance in (
        ("ground, median, m", houses.GROUND_M, 0.15),
        ("roofs above the ground, median, m", ROOF_M, 0.25),
    ):
        if not abs(heights.get(name, np.inf) - truth) < tolerance:
            result.append(f"{name}: {heights.get(name)}")
    if points["of these with points"] != 2:
        result.append(f"{points['of these with points']} of 2 houses with points")
    if not abs(points["points per m2 on footprints, median"] - 1 / 0.64) < 0.2:
        result.append(f"{points['points per m2 on footprints, median']} points per m2")
    if inputs.terrain is not None:
        local = np.array([[0.0, 0.0], [11.0, 7.0], [-9.0, -13.0]])
        at = np.column_stack(to_run.transform(*(local + houses.PLACES[PLACE]).T))
        off_m = inputs.terrain[0].interpolated(*at.T) - terrain_m(*local.T)
        # integers of decimetres are rounded by up to 0.05 m
        if not (np.abs(off_m) < 0.06).all():
            result.append(f"terrain {np.abs(off_m).max():.2f} m off")
    return result


def built(case: Case, files: Files) -> tuple[str, str]:
    """The outcome and reason of a case in a whole run; the volumes are compared, too."""
    cloud, footprints, terrain = case
    crs, settings = options(case)
    outcome, why = looked_at(case, files)
    if outcome != RIGHT:
        return outcome, why
    raster = None if terrain is None else files.terrain(terrain)
    arguments = files.cloud(cloud), files.footprints(footprints)
    more: dict[str, Any] = {
        "crs": crs,
        "terrain": raster,
        "config": {"reconstruct": settings},
        "model": "none",
    }
    with p2wss.reconstruct(*arguments, progress=False, **more) as scene:
        volumes = sorted(float(each.mesh.volume) for each in scene.values())
    off = np.abs(np.array(volumes) / sorted(houses.VOLUME_M3.values()) - 1)
    return (RIGHT, "") if (off < 0.02).all() else (WRONG, f"volumes {np.round(volumes)}")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--num", type=int, default=5000)
    parser.add_argument("--whole", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    start = time.monotonic()
    counts: Counter[str] = Counter()
    shown: Counter[str] = Counter()
    refusals: Counter[tuple[str, str]] = Counter()
    by_part: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        files = Files(Path(folder))
        for number in range(arguments.num):
            case = drawn(np.random.default_rng([arguments.seed, number]))
            outcome, why = looked_at(case, files)
            counts[outcome] += 1
            for name in (case[0].plane, case[0].form, f"heights by {case[0].by}", case[1].ending):
                by_part.setdefault(name, Counter())[outcome] += 1
            key = why.split(": ")[0]
            if outcome in (REFUSED, TOLD):
                refusals[outcome, re.sub(r"[-+]?\d[\d.,]*", "N", why.split(": ", 1)[-1])[:90]] += 1
            if outcome == WRONG and shown[key] < 3:
                shown[key] += 1
                print(f"{number}: {why}\n    {[astuple(each) for each in case if each is not None]}")
        whole: Counter[str] = Counter()
        for number in range(arguments.whole):
            case = drawn(np.random.default_rng([arguments.seed, 1, number]))
            outcome, why = built(case, files)
            whole[outcome] += 1
            if outcome == WRONG:
                print(
                    f"whole run {number}: {why}\n    {[astuple(each) for each in case if each is not None]}"
                )
    names = (RIGHT, REFUSED, TOLD, WRONG)
    print(f"{'':<22}" + "".join(f"{name:>16}" for name in names))
    for title, row in [("all", counts), *sorted(by_part.items()), ("whole runs", whole)]:
        print(f"{title:<22}" + "".join(f"{row[name]:>16}" for name in names))
    for (outcome, why), count in refusals.most_common(15):
        print(f"{count:>6} {outcome}: {why}")
    figures = Figures()
    figures.at_most("silently_wrong", counts[WRONG] + whole[WRONG], 0)
    figures.at_most("seconds", time.monotonic() - start, 600)
    figures.row("outcomes", counts)
    return figures.end()


if __name__ == "__main__":
    sys.exit(main())

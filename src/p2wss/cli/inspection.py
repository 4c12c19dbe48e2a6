"""Describe the contents of files that p2wss writes, and of files of IGN that it reads."""

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import yaml

from p2wss.storage import files, integrity
from p2wss.storage.las_crs import crs_of, horizontal, in_degrees, placed
from p2wss.storage.las_files import bounds_of
from p2wss.storage.messages import InputError, reading

Facts = dict[str, Any]


INTACT = "intact"


def check(path: Path) -> Facts:
    """Verify a file: its name, and as ``checksum`` :data:`INTACT` or a description of the problem.

    The shards that a manifest lists are checked, too, and so are the files that the summary of a reconstruction lists.
    """
    try:
        intact = None if path.is_dir() else integrity.is_intact(path)  # a file geodatabase is a folder
        if intact is False:
            result = f"damaged or changed; {integrity.REMEDY}"
        elif intact is None:
            result = "none stated; the summary of a run lists those of its meshes"
        else:
            result = INTACT
            content = files.read_json(path) if path.suffix == ".json" else None
            if isinstance(content, dict) and content.get("shards"):
                from p2wss.data.manifest import read_manifest

                for shard in read_manifest(path).shards:
                    shard.verified()
            elif isinstance(content, dict) and isinstance(content.get("sha256"), dict):
                result = _check_listed(path.parent, content["sha256"])
    except OSError as error:
        result = f"not readable: {error.strerror or error}"
    except InputError as error:
        result = str(error)
    return {"file": str(path), "checksum": result}


def _check_listed(folder: Path, sums: dict[str, str]) -> str:
    """:data:`INTACT`, or the problems of the files that do not have the stated SHA-256."""
    wrong = []
    for name, stated in sums.items():
        try:
            if files.sha256(folder / name) != stated:
                wrong.append(f"{name}: damaged or changed")
        except OSError as error:
            wrong.append(f"{name}: not readable: {error.strerror or error}")
    return "; ".join(wrong) or INTACT


def describe(path: Path) -> Facts:
    """Facts about a file by name, the most important first. ``provenance`` is the metadata that p2wss stored.

    Raises :class:`InputError` if the file is missing, broken or of an unknown type.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if path.is_dir() and path.suffix.lower() != ".gdb":
        raise InputError(f"{path}: is a folder; name its files, or footprints after it")
    name = path.name.lower()
    reader = next((read for suffixes, read in _READERS if name.endswith(suffixes)), _other)
    with reading(path, f"readable as {Path(name).suffix}, or truncated"):
        facts = {"file": str(path), "num_bytes": path.stat().st_size, **reader(path)}
    return facts | {"checksum": check(path)["checksum"]}


def inputs_of_run(paths: Sequence[Path]) -> tuple[list[Path], Path, Path | None] | None:
    """(clouds, footprints, terrain or None) if these files are inputs of one run, in that order; else None."""
    is_cloud = [path.is_dir() or path.name.lower().endswith(_CLOUDS) for path in paths]
    num_clouds = next((k for k, each in enumerate(is_cloud) if not each), len(paths))
    rest = list(paths[num_clouds:])
    is_raster = [path.name.lower().endswith(_RASTERS) for path in rest]
    is_other = bool(rest) and rest[0].name.lower().endswith(_NO_FOOTPRINTS)
    if not num_clouds or is_raster not in ([False], [False, True]) or is_other:
        return None
    return list(paths[:num_clouds]), rest[0], rest[1] if len(rest) > 1 else None


def text(facts: Facts) -> str:
    """Facts as YAML."""
    plain = json.loads(json.dumps(facts))
    return yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, width=120).rstrip()


def _provenance(stored: str | bytes | Facts | None) -> Facts:
    """The metadata that p2wss stored, with the config as nested sections instead of one line of JSON."""
    if not stored:
        return {}
    facts = stored if isinstance(stored, dict) else json.loads(stored)
    if isinstance(facts.get("config"), str):
        facts["config"] = json.loads(facts["config"])
    return {"provenance": facts}


def _crs(crs: Any) -> str | None:
    if crs is None:
        return None
    parsed = pyproj.CRS.from_user_input(crs)
    code = parsed.to_authority(min_confidence=70)
    return f"{parsed.name} ({':'.join(code)})" if code else parsed.name


def _parquet(path: Path) -> Facts:
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    file = pq.ParquetFile(path)
    schema, metadata = file.schema_arrow, file.metadata.metadata or {}
    facts: Facts = {"kind": "Parquet", "num_rows": file.metadata.num_rows}
    if b"geo" in metadata:
        geo = json.loads(metadata[b"geo"])
        column = geo["columns"][geo["primary_column"]]
        facts |= {
            "kind": "GeoParquet",
            "crs": _crs(column.get("crs", "OGC:CRS84")),
            "bounds": column.get("bbox"),
        }
        facts["geometry types"] = column.get("geometry_types")
    for name in ("status", "split", "method", "roof_type"):
        if name in schema.names:
            counts = pc.value_counts(pq.read_table(path, columns=[name])[name]).to_pylist()
            facts[f"rows by {name}"] = {str(row["values"]): row["counts"] for row in counts}
    facts["columns"] = {
        field.name: f"{field.type}{'' if field.nullable else ' not null'}"
        + (f"  {field.metadata[b'about'].decode()}" if field.metadata and b"about" in field.metadata else "")
        for field in schema
    }
    return facts | _provenance(metadata.get(b"p2wss"))


def _other(path: Path) -> Facts:
    """Describe a vector file of another type, if GDAL knows the type."""
    import pyogrio

    from p2wss.footprints.vector_files import layers_of

    try:
        layers_of(path)
    except pyogrio.errors.DataSourceError as error:
        known = ", ".join(suffix for suffixes, _ in _READERS for suffix in suffixes)
        raise InputError(
            f"{path}: unknown type of file; the known types are {known}, and vector files; convert points in another"
            " format (E57, PLY, text) to LAZ"
        ) from error
    return _vector(path)


def _vector(path: Path) -> Facts:
    import pyogrio

    from p2wss.footprints.vector_files import decoded, layers_of, opening, unpacked

    layers: list[Facts] = []
    with opening(path):
        source = unpacked(path)
        names: list[str | None] = [name for name, _ in layers_of(source)]
        # without a layer that can be read, the error of the first says why
        infos = [
            decoded(source, pyogrio.read_info, layer=name, force_feature_count=True, force_total_bounds=True)
            for name in names or [None]
        ]
    for info in infos:
        metadata = info["layer_metadata"] or {}
        bounds = info["total_bounds"]
        layers.append(
            {
                "layer": info["layer_name"],
                "num_features": info["features"],
                "crs": _crs(info["crs"]),
                "bounds": [float(value) for value in bounds] if bounds is not None else None,
                "geometry type": info["geometry_type"],
                "columns": dict(zip(info["fields"].tolist(), info["dtypes"].tolist(), strict=True)),
                **_provenance(metadata.get("p2wss")),
            }
        )
    dataset = infos[0]["dataset_metadata"] or {}
    return {"kind": f"vector, {infos[0]['driver']}", "layers": layers} | _provenance(dataset.get("p2wss"))


def _raster(path: Path) -> Facts:
    import rasterio

    from p2wss.data.terrain import check_size, height_scale

    with rasterio.open(path) as raster:
        check_size(raster, path)
        heights = raster.read(1, out_dtype="float32", masked=True).filled(np.nan)
        values = heights[np.isfinite(heights)]
        facts: Facts = {
            "kind": f"raster, {raster.driver}",
            "crs": _crs(raster.crs),
            "bounds": list(raster.bounds),
            "num_columns": raster.width,
            "num_rows": raster.height,
            "cell_m": [raster.transform.a, -raster.transform.e],
            "type": raster.dtypes[0],
            "nodata": raster.nodata,
            "share of cells with data": round(len(values) / heights.size, 6),
        }
        if len(values):
            scale, offset = height_scale(raster)
            low, high = (scale * float(end) + offset for end in (values.min(), values.max()))
            facts["heights, m"] = {"lowest": low, "highest": high}
        return facts | _provenance(raster.tags().get("p2wss"))


def _cloud(path: Path) -> Facts:
    from p2wss.fetching.cloud import count_classes, read_header

    header, classes = read_header(path), count_classes(path)
    if classes.total() != header.point_count:
        raise InputError(f"{path}: truncated: {classes.total()} of {header.point_count} points")
    bounds = bounds_of(header)
    crs = crs_of(header)
    area_m2 = 0.0 if bounds is None else _area_m2(bounds, crs)
    is_copc = any(vlr.user_id == "copc" and vlr.record_id == 1 for vlr in header.vlrs)
    return {
        "kind": "point cloud, COPC" if is_copc else f"point cloud, {path.suffix[1:].upper()}",
        "version": f"LAS {header.version}, point format {header.point_format.id}",
        "crs": _crs(crs),
        "bounds": bounds and list(bounds),
        "heights": {"lowest": float(header.mins[2]), "highest": float(header.maxs[2])},
        "num_points": header.point_count,
        "points per m2 of the bounds": round(header.point_count / area_m2, 2) if area_m2 > 0 else None,
        "num_points by class": dict(sorted(classes.items())),
        "scale": header.scales.tolist(),
        "extra dimensions": list(header.point_format.extra_dimension_names),
        "software": f"{header.system_identifier} / {header.generating_software}".strip(" /\0"),
    }


def _area_m2(bounds: tuple[float, float, float, float], crs: pyproj.CRS | None) -> float:
    """The area of bounds on the ground: x and y may be in feet or degrees, or long, as in EPSG:3857. Without a CRS, or
    outside of the Earth, they count as metres."""
    x_min, y_min, x_max, y_max = bounds
    if (known := placed(crs)) is not None:
        flat = horizontal(known)
        x, y = (x_min + x_max) / 2, (y_min + y_max) / 2
        ends = [(x_min, y), (x_max, y), (x, y_min), (x, y_max)]
        west, east, south, north = (in_degrees(flat, *end) for end in ends)
        _, _, sides_m = flat.get_geod().inv(*np.transpose([west, south]), *np.transpose([east, north]))
        if np.isfinite(sides_m).all():
            return float(np.prod(sides_m))
    return (x_max - x_min) * (y_max - y_min)


def _weights(path: Path) -> Facts:
    from safetensors import safe_open

    with safe_open(path, "numpy") as file:
        shapes = [file.get_slice(name).get_shape() for name in file.keys()]  # noqa: SIM118
        metadata = file.metadata() or {}
    return {
        "kind": "weights, safetensors",
        "num_tensors": len(shapes),
        "num_parameters": sum(map(math.prod, shapes)),
        **_provenance(metadata.get("p2wss")),
    }


def _json(path: Path) -> Facts:
    document = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(document, dict):
        return {"kind": "JSON, a list", "num_items": len(document) if isinstance(document, list) else 1}
    if document.get("type") == "CityJSON":
        return {"kind": "CityJSON", **_city([document])}
    if document.get("type") == "FeatureCollection":
        return _vector(path)
    document.pop("checksum", None)
    stored = document.pop("p2wss", None) or {
        name: document.pop(name) for name in ("version", "code", "config") if name in document
    }
    short = {
        name: f"{len(value)} entries" if isinstance(value, list) and len(value) > 8 else value
        for name, value in document.items()
    }
    return {"kind": "JSON"} | short | _provenance(stored)


def _json_lines(path: Path) -> Facts:
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
    lines = [line for line in lines if list(line) != ["checksum"]]
    if lines and lines[0].get("type") == "CityJSON":
        return {"kind": "CityJSON text sequence", **_city(lines)}
    return {"kind": "JSON lines", "num_lines": len(lines), "first": lines[:1], "last": lines[-1:]}


def _glb(path: Path) -> Facts:
    content = path.read_bytes()
    tree = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    extras = tree["asset"].get("extras", {})
    shapes = [shape["primitives"] for shape in tree.get("meshes", [])]
    corners = [tree["accessors"][each["indices"]]["count"] for shape in shapes for each in shape]
    return {
        "kind": "meshes, binary glTF",
        "software": tree["asset"].get("generator"),
        "crs": _crs(extras.get("crs")),
        "origin_m": extras.get("origin_m"),
        "num_meshes": len(shapes),
        "num_triangles": sum(corners) // 3,
        "materials": [material["name"] for material in tree.get("materials", [])],
        **_provenance(extras.get("p2wss")),
    }


def _city(parts: list[Facts]) -> Facts:
    metadata = parts[0].get("metadata", {})
    city_objects = [item for part in parts for item in part.get("CityObjects", {}).values()]
    templates = parts[0].get("geometry-templates", {}).get("templates", [])
    given = [shape for item in city_objects for shape in item.get("geometry", [])]
    geometry = [templates[shape["template"]] if "template" in shape else shape for shape in given]
    stored = parts[0].get("+p2wss") or metadata.get("p2wss")
    return {
        "version": parts[0].get("version"),
        "crs": _crs(metadata.get("referenceSystem")),
        "bounds": metadata.get("geographicalExtent"),
        "num_features": len(parts) - 1 or None,
        "objects by type": dict(Counter(item["type"] for item in city_objects)),
        "geometries by level of detail": dict(
            Counter(f"{shape['type']} LoD{shape.get('lod')}" for shape in geometry)
        ),
        **_provenance(stored),
    }


_RASTERS, _CLOUDS = (".tif", ".tiff", ".asc", ".vrt"), (".laz", ".las")
_NO_FOOTPRINTS = (".safetensors", ".glb", ".jsonl", ".city.json")
_READERS: list[tuple[tuple[str, ...], Callable[[Path], Facts]]] = [
    ((".parquet",), _parquet),
    ((".gpkg", ".shp", ".geojson", ".fgb", ".gml", ".zip"), _vector),
    (_RASTERS, _raster),
    (_CLOUDS, _cloud),
    ((".safetensors",), _weights),
    ((".glb",), _glb),
    ((".jsonl",), _json_lines),
    ((".json",), _json),
]

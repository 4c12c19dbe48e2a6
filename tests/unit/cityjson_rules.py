"""What a validator of CityJSON 2.0 and of its solids checks, written anew from the specification.

https://www.cityjson.org/specs/2.0.1/ ; for solids ISO 19107 as val3dity tests it: closed shells, planar faces,
outward orientation, semantics that fit the direction of a face.
"""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np

PLANAR_M = 0.01  # val3dity's own tolerance


def assert_document(document: dict[str, Any]) -> int:
    """A whole CityJSON object; the number of its solids."""
    assert set(document) == {"type", "version", "transform", "CityObjects", "vertices"} | (
        {"metadata"} & set(document)
    )
    assert (document["type"], document["version"]) == ("CityJSON", "2.0")
    transform = document["transform"]
    assert set(transform) == {"scale", "translate"} and all(len(v) == 3 for v in transform.values())
    assert all(scale > 0 for scale in transform["scale"])
    metadata = document.get("metadata", {})
    assert set(metadata) <= {"referenceSystem", "geographicalExtent", "title", "referenceDate"}
    if "referenceSystem" in metadata:
        assert metadata["referenceSystem"].startswith("https://www.opengis.net/def/crs/EPSG/0/")
    used = assert_objects(document["CityObjects"], document["vertices"], transform)
    vertex_m = np.array(document["vertices"], float).reshape(-1, 3) * transform["scale"]
    if "geographicalExtent" in metadata:
        extent = np.array(metadata["geographicalExtent"]).reshape(2, 3) - transform["translate"]
        assert np.allclose(extent, [vertex_m.min(axis=0), vertex_m.max(axis=0)], atol=1e-3)
    return used


def assert_sequence(lines: list[dict[str, Any]]) -> int:
    """A CityJSONSeq: header, then features; the number of their solids."""
    header, *features = lines
    assert header["CityObjects"] == {} and header["vertices"] == []
    assert_document(header)
    total = 0
    for feature in features:
        assert set(feature) == {"type", "id", "CityObjects", "vertices"}
        assert feature["type"] == "CityJSONFeature" and feature["id"] in feature["CityObjects"]
        total += assert_objects(feature["CityObjects"], feature["vertices"], header["transform"])
    return total


def assert_objects(objects: dict[str, Any], vertices: list[list[int]], transform: dict[str, Any]) -> int:
    assert all(len(v) == 3 and all(type(c) is int for c in v) for v in vertices)
    vertex_m = np.array(vertices, float).reshape(-1, 3) * transform["scale"]
    used: set[int] = set()
    solids = 0
    for name, city_object in objects.items():
        assert isinstance(name, str) and city_object["type"] == "Building"
        assert set(city_object) <= {"type", "attributes", "geometry"}
        for value in city_object["attributes"].values():
            assert value is None or isinstance(value, str | bool | int | float)
        for geometry in city_object.get("geometry", []):
            assert set(geometry) == {"type", "lod", "boundaries", "semantics"}
            assert geometry["type"] == "Solid" and geometry["lod"] in ("1.2", "2.0")
            (shell,) = geometry["boundaries"]
            (values,) = geometry["semantics"]["values"]
            kinds = [surface["type"] for surface in geometry["semantics"]["surfaces"]]
            assert len(values) == len(shell) and set(values) == set(range(len(kinds)))
            for surface in geometry["semantics"]["surfaces"]:
                assert_semantics(surface)
            faces = [[np.array(ring) for ring in rings] for rings in shell]
            indices = {int(v) for rings in faces for ring in rings for v in ring}
            assert min(indices) >= 0 and max(indices) < len(vertices)
            # no two vertices of a building in one place
            assert len({tuple(vertices[v]) for v in indices}) == len(indices)
            used |= indices
            assert_solid(vertex_m, faces, [kinds[value] for value in values])
            solids += 1
    assert used == set(range(len(vertices)))
    return solids


def assert_semantics(surface: dict[str, Any]) -> None:
    """Other surfaces have a type alone; a roof surface is one plane with its slope, direction and area."""
    if surface["type"] != "RoofSurface":
        assert set(surface) == {"type"}
        return
    assert set(surface) - {"azimuth_deg"} == {"type", "slope_deg", "area_m2"}
    assert ("azimuth_deg" in surface) == (surface["slope_deg"] >= 0.1)
    assert 0 <= surface["slope_deg"] < 90 and surface["area_m2"] > 0
    assert 0 <= surface.get("azimuth_deg", 0) < 360


def assert_solid(vertex_m: np.ndarray, shell: list[list[np.ndarray]], kinds: list[str]) -> None:
    edges = Counter(
        (int(a), int(b)) for rings in shell for ring in rings for a, b in pairwise([*ring, ring[0]])
    )
    assert set(edges.values()) == {1} and {(b, a) for a, b in edges} == set(edges), "not closed"
    volume = 0.0
    for rings, kind in zip(shell, kinds, strict=True):
        assert all(len(ring) >= 3 and len(set(ring.tolist())) == len(ring) for ring in rings)
        areas = [_area_vector(vertex_m[ring]) for ring in rings]
        normal = areas[0] / np.linalg.norm(areas[0])
        for area in areas[1:]:
            assert area @ normal < 0, "a hole turns the other way round"
        corners = vertex_m[np.concatenate(rings)]
        assert np.abs((corners - corners.mean(axis=0)) @ normal).max() <= PLANAR_M, "not planar"
        volume += float(corners[0] @ sum(areas)) / 3
        level = {
            "GroundSurface": normal[2] < -0.999,
            "RoofSurface": normal[2] > 0.05,
            "OuterFloorSurface": normal[2] > 0.999,
        }
        assert level.get(kind, abs(normal[2]) < 0.06), f"{kind} faces {normal}"
    assert volume > 0, "inside out"


def _area_vector(ring_m: np.ndarray) -> np.ndarray:
    local = ring_m - ring_m[0]
    return np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0) / 2

"""The CityJSON output of ``p2wss reconstruct``: solids, blocks of LoD 1.2, metadata."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import pyproj
from pyproj.database import query_crs_info
from pyproj.enums import PJType

from p2wss import __version__, skeleton
from p2wss.formats import cityjson
from p2wss.formats.cityjson import Metadata, Solid
from p2wss.mesh import Mesh
from p2wss.mesh.faces import Surface
from p2wss.mesh.repair import surfaces_to_write
from p2wss.reconstruction.outputs.attributes import NAMES_3DBAG, P2WSS, TO_3DBAG, attributes
from p2wss.reconstruction.outputs.vegetation import Plant
from p2wss.reconstruction.result import Result
from p2wss.skeleton.types import FaceKind, Polygons
from p2wss.storage.las_crs import horizontal
from p2wss.storage.messages import first_of

# the title names at most this many clouds
_MAX_CLOUDS = 3


def city_json(
    results: Sequence[Result],
    crs: pyproj.CRS,
    output: str = "cityjsonseq",
    facts: Mapping[str, Any] | None = None,
    lods: Sequence[str] = ("2.0",),
    names: str = P2WSS,
    plants: Sequence[Plant] = (),
) -> Iterator[str]:
    """All buildings as a CityJSON text sequence, or as one document for the output ``cityjson``; yields pieces of text.
    Buildings without a mesh have no geometry, and follow the others.

    facts: of the run, for attributes and metadata. lods: levels of detail, from 1.2 and 2.0. names: of attributes, see
    :func:`attributes`. plants: follow the buildings.
    """
    facts = facts or {}
    has_mesh: list[bool] = []
    days: set[str] = set()
    for result in results:
        has_mesh.append(result.reconstruction.has_mesh)
        days |= {day.isoformat() for day in result.dates or ()}
    order = sorted(range(len(results)), key=lambda number: not has_mesh[number])
    solids = chain((solid(results[number], facts, lods, names) for number in order), map(_plant, plants))
    metadata = _metadata(sorted(days), crs, facts, names)
    if output == "cityjson":
        yield from cityjson.document_pieces(solids, metadata)
        yield "\n"
        return
    for line in cityjson.lines(solids, metadata):
        yield line
        yield "\n"


def _metadata(days: Sequence[str], crs: pyproj.CRS, facts: Mapping[str, Any], names: str) -> Metadata:
    """The metadata. The title and the reference date tell version and sources, as CityJSON has no other place for
    them."""
    title = f"Buildings by p2wss {__version__}"
    clouds = facts.get("clouds", [])
    if clouds:
        title += f" from {first_of(clouds, _MAX_CLOUDS)}"
    if days:
        title += f", points of {days[0]}" + (f" to {days[-1]}" if len(days) > 1 else "")
    columns = {"slope": "slope_deg", "azimuth": "azimuth_deg"}
    if names == NAMES_3DBAG:
        columns = {key: TO_3DBAG[name] for key, name in columns.items()}
    return Metadata(epsg_of(crs), title, days[-1] if days else None, **columns)


def epsg_of(crs: pyproj.CRS) -> int | None:
    """The EPSG code of a CRS. For a compound CRS it is the code of the compound, if there is one, else the code of its
    horizontal part, as for a CRS with heights above the ellipsoid. None if there is no code.

    >>> epsg_of(pyproj.CRS("EPSG:28992+5709")), epsg_of(pyproj.CRS("EPSG:2154+5720")), epsg_of(pyproj.CRS("EPSG:2154"))
    (7415, 5698, 2154)
    """
    code = crs.to_epsg()
    if code is not None:
        return code
    parts = [part.to_epsg() for part in crs.sub_crs_list]
    names = " + ".join(pyproj.CRS(part).name for part in parts if part is not None)
    for info in query_crs_info("EPSG", PJType.COMPOUND_CRS) if parts and None not in parts else []:
        if info.name == names:
            return int(info.code)
    return horizontal(crs).to_epsg()


def solid(
    result: Result,
    facts: Mapping[str, Any] | None = None,
    lods: Sequence[str] = ("2.0",),
    names: str = P2WSS,
) -> Solid:
    """The building for CityJSON, its triangles merged into planar polygons."""
    reconstruction = result.reconstruction
    values = attributes(result, facts, names)
    if not reconstruction.has_mesh:
        return Solid(reconstruction.building_id, np.zeros((0, 3)), [], values)
    mesh = reconstruction.placed_mesh
    surfaces = (reconstruction.surfaces or surfaces_to_write(mesh)[0]) if "2.0" in lods else []
    block = _block(result) if "1.2" in lods else None
    if block is None:
        return Solid(reconstruction.building_id, mesh.vertex_m, surfaces, values)
    return Solid(reconstruction.building_id, mesh.vertex_m, surfaces, values, block[0].vertex_m, block[1])


def _plant(plant: Plant) -> Solid:
    vertex_m, triangle = plant.mesh.vertex_m, plant.mesh.triangle
    surfaces = [Surface(FaceKind.WALL, -1, [ring]) for ring in triangle]
    return Solid(plant.name, vertex_m, surfaces, dict(plant.attributes), city_type=plant.city_type)


def _block(result: Result) -> tuple[Mesh, list[Surface]] | None:
    """(a block for LoD 1.2, its surfaces); None if no block is valid. The block stands on the floor of the building, or
    on its footprint if the kernel rejects the floor. Its flat roof is at the 70th percentile of the building's roof."""
    reconstruction, measured = result.reconstruction, result.measures
    assert measured is not None and reconstruction.mesh is not None
    solid, height_m = reconstruction.mesh, measured.roof_z_p70_m - reconstruction.ground_z_m
    # only the floor, without open ground, which is outside the building; its rings are reversed, as seen from above
    floors = [surface.rings for surface in solid.surfaces if surface.kind == FaceKind.GROUND]
    of_floor = [[solid.vertex_m[ring[::-1], :2] for ring in rings] for rings in floors if len(floors) == 1]
    for rings in (*of_floor, list(reconstruction.rings)):
        meshes = skeleton.build(
            Polygons.from_rings([rings]), np.zeros(sum(map(len, rings))), np.array([height_m])
        )
        if meshes.status[0] == skeleton.Status.OK:
            mesh = Mesh.of_kernel(meshes, 0).translated(reconstruction.position_m)
            surfaces, broken = surfaces_to_write(mesh)
            if not broken:
                return mesh, surfaces
    return None

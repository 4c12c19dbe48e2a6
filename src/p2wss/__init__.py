"""Closed buildings from building footprints and airborne LiDAR, for radar and radio-propagation simulation.

    >>> import p2wss
    >>> house = p2wss.roof([[0, 0], [10, 0], [10, 6], [0, 6]], eave_height_m=5, angle_deg=[45, 90, 45, 90])
    >>> house.is_watertight, round(house.volume), round(house.bounds[1, 2])
    (True, 390, 8)

The names here are the public interface; docs/manual/python.md shows them at work. Each imports what it needs when it is
called, so ``import p2wss`` is fast. A wrong input raises :class:`InputError`, whose message is one line: what is wrong,
where, and what to do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from p2wss.storage.arguments import public
from p2wss.storage.messages import InputError

if TYPE_CHECKING:
    import geopandas as gpd
    import laspy
    import pandas as pd
    import pyproj
    import shapely
    import trimesh
    from numpy.typing import ArrayLike

    from p2wss.config import Config
    from p2wss.fetching.area import Fetched
    from p2wss.formats.validity import Validity
    from p2wss.reconstruction.inputs import CloudInput, FootprintInput, LineInput
    from p2wss.reconstruction.scene import Scene

__version__ = "0.2.0"
__all__ = [
    "InputError",
    "check",
    "evaluate",
    "fetch",
    "outlines",
    "read",
    "reconstruct",
    "roof",
    "scan",
]


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


@public
def reconstruct(
    cloud: CloudInput,
    footprints: FootprintInput | None = None,
    *,
    crs: str | None = None,
    ids: Sequence[str] | None = None,
    bbox: tuple[float, float, float, float] | None = None,
    terrain: str | Path | None = None,
    lines: LineInput | None = None,
    detail: str | None = None,
    model: str | Path | None = None,
    config: Config | str | Path | dict[str, Any] | None = None,
    threads: int = 1,
    progress: bool | Callable[[int, int], object] = True,
) -> Scene:
    """Reconstruct buildings: one closed solid per footprint, or the reason why there is none.

    Parameters
    ----------
    cloud : path, sequence of paths, array, table, or laspy.LasData
        LAS, LAZ or COPC files or folders of them; points (n, 3), or (n, 4) with LAS classes, or with these as columns
        x, y, z and classification; or what laspy has read.
    footprints : path, GeoDataFrame, GeoSeries or polygons, optional
        In any CRS. Without them, outlines are derived from the points.
    crs : str, optional
        Of clouds that do not state theirs, such as ``EPSG:28992``.
    ids : sequence of str, optional
        Only these buildings.
    bbox : (x_min, y_min, x_max, y_max), optional
        Only the buildings with their centre in it, in the CRS of the run.
    terrain : path, optional
        A raster of heights, in which written meshes then stand.
    lines : path, GeoDataFrame, GeoSeries or lines, optional
        Ridges, valleys and other lines of roofs that a map knows: planes may end there if the points do not contradict.
    detail : {"low", "normal", "high"}, optional
    model : path or str, optional
        Weights of Point2WSS, or ``"point2wss"`` for those of the package, for buildings as that network predicts them;
        ``"none"`` for no network at all. By default a fit, with a network that completes roofs of few points.
    config : path, dict or Config, optional
        A file, or sections such as ``{"reconstruct": {"roofs": "parametric"}}``. docs/manual and config/default.yaml
        describe every setting.
    threads : int
        Of the network. Without one, as many processes fit.
    progress : bool or callable
        Whether to show a bar, or a function that is called with (number done, number in all).

    Returns
    -------
    Scene
        The buildings by their ids. A building that cannot be reconstructed raises nothing: its ``status`` and
        ``reason`` tell.

    Raises
    ------
    InputError
        For inputs that cannot work, before anything slow begins.

    Examples
    --------
    >>> import geopandas, numpy, shapely
    >>> x, y = numpy.meshgrid(numpy.arange(-4, 14, 0.4), numpy.arange(-4, 10, 0.4))
    >>> inside = (x > 0) & (x < 10) & (y > 0) & (y < 6)
    >>> z = numpy.where(inside, 5 + numpy.minimum(y, 6 - y), 0)  # a gable roof of 45 degrees
    >>> points = numpy.column_stack([v.ravel() for v in (x, y, z, numpy.where(inside, 6, 2))])
    >>> footprints = geopandas.GeoDataFrame({"id": ["a"]}, geometry=[shapely.box(0, 0, 10, 6)], crs=2154)
    >>> scene = reconstruct(points, footprints, model="none", progress=False)
    >>> scene["a"].status, scene["a"].mesh.is_watertight, round(scene["a"].mesh.volume)
    ('ok', True, 390)
    """
    from p2wss.config import as_config
    from p2wss.reconstruction.inputs import check_inputs

    settings = as_config(config, detail)
    inputs = check_inputs(cloud, footprints, settings, crs, terrain, model, lines=lines)
    from p2wss.reconstruction import run  # only now, as it takes a second

    return run.reconstruct(inputs, settings, run.Selection(ids, bbox), run.Machine(threads=threads), progress)


@public
def read(path: str | Path) -> Scene:
    """The buildings of a CityJSON file or text sequence, by this package or another program, at the highest level of
    detail that each has.

    Parameters
    ----------
    path : path

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If the file is missing or broken.
    """
    from p2wss.reconstruction import scene

    return scene.read(path)


@public
def evaluate(
    buildings: Scene | str | Path,
    footprints: FootprintInput,
    clouds: CloudInput,
    *,
    crs: str | None = None,
    id_field: str | None = None,
    config: Config | str | Path | dict[str, Any] | None = None,
) -> pd.DataFrame:
    """How far the points of each building are from its mesh, with one row per footprint.

    Parameters
    ----------
    buildings : Scene or path
        A scene, or a CityJSON file of any program.
    footprints, clouds
        As in :func:`reconstruct`.
    crs : str
        Of the clouds, whatever they state.
    id_field : str, optional
        Column of the footprints with the ids of the buildings.
    config : path, dict or Config, optional
        Of it, ``region.classes`` and ``height_unit``, ``footprint_layer`` and ``id_field`` of ``reconstruct`` count.

    Returns
    -------
    pandas.DataFrame
        Its columns: see :func:`p2wss.eval.files.evaluate`.

    Raises
    ------
    InputError
        For inputs that cannot work.
    """
    from p2wss.config import as_config
    from p2wss.eval import files

    return files.evaluate(buildings, footprints, clouds, as_config(config), crs=crs, id_field=id_field)


@public
def outlines(
    cloud: CloudInput,
    *,
    crs: str | None = None,
    config: Config | str | Path | dict[str, Any] | None = None,
) -> gpd.GeoDataFrame:
    """Outlines of buildings from points alone, for places without footprints (docs/manual/outlines.md).

    Parameters
    ----------
    cloud, crs, config
        As in :func:`reconstruct`.

    Returns
    -------
    geopandas.GeoDataFrame
        A row per building, with its id.

    Raises
    ------
    InputError
        For inputs that cannot work.
    """
    from p2wss.config import as_config
    from p2wss.reconstruction.inputs import check_inputs, read_outlines

    settings = as_config(config)
    return read_outlines(check_inputs(cloud, None, settings, crs), settings)[1].to_frame()


@public
def check(path: str | Path) -> Validity:
    """Whether the solids of a CityJSON file follow the rules of ISO 19107, with the default tolerances of val3dity.

    Parameters
    ----------
    path : path

    Returns
    -------
    Validity
        Its ``invalid`` has the errors of each invalid solid, and is empty if all are valid.

    Raises
    ------
    InputError
        For a file that is missing, broken or without solids.
    """
    from p2wss.formats.validity import check_file

    return check_file(path)


@public
def fetch(
    bbox: tuple[float, float, float, float],
    crs: str = "EPSG:4326",
    *,
    folder: str | Path = "p2wss-data",
    config: Config | str | Path | dict[str, Any] | None = None,
) -> Fetched:
    """Footprints, terrain and LiDAR of a place in France from IGN's services, or from the folders of the config.

    Parameters
    ----------
    bbox : (x_min, y_min, x_max, y_max)
        In ``crs``: by default longitude and latitude in degrees.
    crs : str
    folder : path
        Where the files are written, and kept for the next call.
    config : path, dict or Config, optional

    Returns
    -------
    Fetched
        The paths, which :func:`reconstruct` takes.

    Raises
    ------
    InputError
        For a box that is not in ``crs``, and if a service does not answer.

    Examples
    --------
    >>> data = p2wss.fetch((2.350, 48.853, 2.354, 48.856))  # doctest: +SKIP
    >>> scene = p2wss.reconstruct(data.clouds, data.footprints, terrain=data.terrain)  # doctest: +SKIP
    """
    from p2wss.config import IGN, Config, load
    from p2wss.fetching.area import fetch_area

    settings = config if isinstance(config, Config) else load(IGN, config or {})
    return fetch_area(bbox, crs, Path(folder), settings)


@public
def roof(
    footprint: shapely.Polygon | shapely.MultiPolygon | ArrayLike,
    eave_height_m: float,
    angle_deg: float | ArrayLike,
) -> trimesh.Trimesh:
    """The building of the paper (section 3): a footprint, a height and an angle per edge make a closed mesh.

    Parameters
    ----------
    footprint : Polygon, MultiPolygon of one part, or (n, 2)
        In metres. Its rings may turn either way.
    eave_height_m : float
        Above the ground, z = 0.
    angle_deg : float or sequence of float
        0, 90 or 5 to 85, one for all edges or one per edge over all rings: edge i begins at vertex i, and 90 is a
        gable.

    Returns
    -------
    trimesh.Trimesh

    Raises
    ------
    InputError
        For a footprint or angles without a roof.

    Examples
    --------
    >>> pyramid = roof([[0, 0], [8, 0], [8, 8], [0, 8]], 3, 45)
    >>> len(pyramid.faces), pyramid.bounds[1].round(6).tolist()
    (14, [8.0, 8.0, 7.0])
    """
    from p2wss.scenes.buildings import roof_mesh

    return roof_mesh(footprint, eave_height_m, angle_deg)


@public
def scan(
    meshes: trimesh.Trimesh | Sequence[trimesh.Trimesh] | Scene,
    terrain: str | Path | None = None,
    *,
    crs: str | pyproj.CRS | None = None,
    config: Config | str | Path | dict[str, Any] | None = None,
    seed: int | None = None,
    threads: int = 1,
) -> laspy.LasData:
    """An airborne LiDAR survey over meshes, simulated by ray casting (section 5.1 of the paper).

    Needs the extra ``scan``.

    Parameters
    ----------
    meshes : Trimesh, a sequence of them, or Scene
        Closed, z up, metres. A scene of a file in feet or degrees is converted, as a run would convert it.
    terrain : path, optional
        A raster of heights. By default level ground at the lowest vertex.
    crs : str or CRS, optional
        Of the points; one in metres. By default that of the scene.
    config : path, dict or Config, optional
        Its section ``scans`` describes the scanner and the flight.
    seed : int, optional
        By default that of the config.
    threads : int

    Returns
    -------
    laspy.LasData
        Points with LAS classes (2 ground, 6 building) and the extra dimensions ``building_id``, the number of the mesh
        from 0, and ``face_id``, 1 on its walls and 2 on its roof; both are -1 on the ground. Its ``write("a.laz")``
        writes them.

    Raises
    ------
    InputError
        For a raster or settings that cannot work.

    Examples
    --------
    >>> points = scan([roof([[0, 0], [10, 0], [10, 6], [0, 6]], 5, [45, 90, 45, 90])])
    >>> bool((points.classification == 6).any()), round(float(points.z.max()))
    (True, 8)
    """
    from p2wss.config import as_config
    from p2wss.scans.scan import scan_meshes

    return scan_meshes(meshes, terrain, crs, as_config(config).scans, seed, threads)

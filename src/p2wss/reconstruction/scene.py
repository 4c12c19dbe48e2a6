"""A scene: the buildings of a run or of a CityJSON file, to be looked at, measured and written.

The results of a run stay in temporary files until the scene is closed or garbage-collected. So a scene of a large area
needs no more memory than the points of one batch.
"""

from __future__ import annotations

import html
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import shapely

from p2wss.clouds.crops import crop_cloud
from p2wss.config import OUTPUT_SUFFIXES, Config, load
from p2wss.data import polygon_arrays
from p2wss.data.crs import MetricCrs, metric_crs
from p2wss.data.tiling import Bounds, bounds_of_points, grown
from p2wss.formats import cityjson_read
from p2wss.formats.cityjson import SURFACE_TYPE
from p2wss.formats.meshes import VEGETATION, Body, frame_around
from p2wss.formats.outputs import MESH_WRITERS
from p2wss.mesh import Mesh, faces
from p2wss.reconstruction.area import MARGIN_M
from p2wss.reconstruction.inputs import Inputs
from p2wss.reconstruction.outputs import exports, page, picture, vegetation
from p2wss.reconstruction.outputs.attributes import attributes, table
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.reconstruction.result import STATUSES, Result, summary
from p2wss.reconstruction.running.failures import Failures
from p2wss.reconstruction.skin import block_skins
from p2wss.skeleton.types import FaceKind
from p2wss.storage import files
from p2wss.storage.arguments import checked, public
from p2wss.storage.messages import InputError, log
from p2wss.storage.temporary import Closeable

if TYPE_CHECKING:
    import geopandas as gpd
    import trimesh

    from p2wss.reconstruction.explain import Explanation


@dataclass(frozen=True)
class Surface:
    """A planar polygon of a building.

    Attributes
    ----------
    kind : str
        ``RoofSurface``, ``WallSurface``, ``GroundSurface`` or ``OuterFloorSurface``.
    rings_m : sequence of (n, 3)
        In the CRS of the scene, the exterior first, counter-clockwise seen from outside.
    """

    kind: str
    rings_m: Sequence[np.ndarray]

    @property
    def normal(self) -> np.ndarray:
        """The unit normal (3,), outwards (Newell's formula)."""
        total = np.sum([faces.doubled_area(ring) for ring in self.rings_m], axis=0)
        return total / np.linalg.norm(total)


@dataclass(frozen=True)
class SceneBuilding:
    """A building of a scene.

    Attributes
    ----------
    building_id : str
    status : {"ok", "flat", "none"}
        ``flat``: a flat roof instead of a fitted one, ``none``: no mesh; ``reason`` says why.
    reason : str or None
    attributes : mapping
        As in the files, see docs/manual/attributes.md.
    footprint : Polygon or None
        The footprint of the mesh, in the CRS of the scene: moved by the registration, with walls where the fit has put
        them. None if there is no footprint.
    solid : Mesh or None
        The closed mesh in the CRS of the scene; None without a mesh.
    """

    building_id: str
    status: str
    reason: str | None
    attributes: Mapping[str, Any]
    footprint: shapely.Polygon | None
    solid: Mesh | None = field(repr=False)
    _polygons: Sequence[faces.Surface] = field(default=(), repr=False)

    @property
    def not_representable(self) -> bool:
        """Whether the points are far from the mesh, which may lack parts of the building."""
        return bool(self.attributes.get("not_representable"))

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The closed mesh, vertices in the CRS of the scene; without faces if there is none. The ``kind`` of each face
        (:class:`p2wss.skeleton.FaceKind`) is among its ``face_attributes``."""
        import trimesh

        return trimesh.Trimesh() if self.solid is None else self.solid.to_trimesh()

    @cached_property
    def surfaces(self) -> Sequence[Surface]:
        """The planar polygons of the mesh, as CityJSON has them."""
        if self.solid is None:
            return []
        return [
            Surface(SURFACE_TYPE[FaceKind(each.kind)], [self.solid.vertex_m[ring] for ring in each.rings])
            for each in self._polygons or self.solid.surfaces
        ]


class Scene(Mapping[str, SceneBuilding], Closeable):
    """The buildings of a run or of a file, by their ids in the order of the footprints.

    Attributes
    ----------
    crs : CRS or None
        The CRS of all coordinates; None for a file that states no CRS.
    config : Config
    name : str
    plants : mapping of Mesh
        The closed volumes that ``--vegetation`` adds, by their ids.
    """

    def __init__(
        self,
        ids: Sequence[str],
        building: Callable[[int], SceneBuilding],
        crs: pyproj.CRS | None,
        config: Config,
        name: str,
        run: Run | None = None,
        plants: Mapping[str, Mesh] | None = None,
    ) -> None:
        self._number = {each: number for number, each in enumerate(ids)}
        self._building, self._run = building, run
        self.crs, self.config, self.name, self.plants = crs, config, name, plants or {}

    def __getitem__(self, building_id: str) -> SceneBuilding:
        return self._building(self._number[building_id])

    def __iter__(self) -> Iterator[str]:
        return iter(self._number)

    def __len__(self) -> int:
        return len(self._number)

    def __repr__(self) -> str:
        return f"<Scene {self.name}: {len(self)} buildings, {'unknown CRS' if self.crs is None else self.crs.name}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """A copied or unpickled scene has the buildings, but not the run with its points."""
        building = list(self.values()).__getitem__
        return Scene, (list(self), building, self.crs, self.config, self.name, None, self.plants)

    @property
    def bounds(self) -> Bounds | None:
        """x_min, y_min, x_max and y_max of all meshes, in the CRS of the scene; None without a mesh."""
        return bounds_of([each.solid for each in self.values() if each.solid is not None])

    def converted(self, metric: MetricCrs) -> Scene:
        """The scene with its meshes in ``metric.crs``, without footprints. The scene is of a file, in the CRS
        ``metric.source``."""

        def building(number: int) -> SceneBuilding:
            each = self._building(number)
            solid = None if each.solid is None else metric.mesh(each.solid)
            return replace(each, solid=solid, footprint=None, _polygons=())

        plants = {name: metric.mesh(plant) for name, plant in self.plants.items()}
        return Scene(list(self), building, metric.crs, self.config, self.name, plants=plants)

    def in_metres(self) -> Scene:
        """The scene in a CRS in metres, as mesh files and surveys need it: the CRS of a run on clouds in the CRS of the
        scene. The scene is of a file."""
        if self.crs is None or self.bounds is None:
            return self
        metric, _ = metric_crs(self.crs, self.bounds, self.name)
        if metric.is_source:
            return self
        log.warning(
            "warning: %s is in %s; its meshes are taken in %s, in metres",
            self.name,
            self.crs.name,
            metric.crs.name,
        )
        return self.converted(metric)

    def close(self) -> None:
        """Remove the temporary files of the run; the scene cannot be used afterwards."""
        if self._run is not None:
            self._run.resources.close()

    @property
    def summary(self) -> str:
        """One line: how many buildings of each status, and why."""
        return summary(self.values() if self._run is None else self._run.results)

    @property
    def table(self) -> gpd.GeoDataFrame:
        """The footprint and the attributes of each building, indexed by ``building_id``."""
        if self._run is not None:
            names = self.config.reconstruct.attribute_names
            features = table(self._run.kept, self._run.inputs.crs, self._run.facts, names)
            return features.to_frame().set_index("building_id")
        import geopandas as gpd

        rows, shapes = [each.attributes for each in self.values()], [each.footprint for each in self.values()]
        return gpd.GeoDataFrame(rows, index=list(self), geometry=shapes, crs=self.crs).rename_axis(
            "building_id"
        )

    def points(self, building_id: str) -> np.ndarray:
        """The points of a building: those within ``reconstruct.buffer_m`` of its footprint before the fit moved walls.

        Parameters
        ----------
        building_id : str

        Returns
        -------
        (n, 3)
            In the CRS of the scene.

        Raises
        ------
        InputError
            For a scene that was read from a file, which has no points.
        """
        if self._run is None:
            raise InputError(f"{self.name}: has no points: it is a copy, or was read from a file")
        number = np.array([self._number[building_id]])
        results = [self._run.results[number[0]]]
        (footprint,) = as_registered(self._run.footprints[number], np.zeros(1, int), results)
        if footprint.is_empty:
            return np.zeros((0, 3))
        cloud = self._run.points.near(np.array([grown(footprint.bounds, MARGIN_M)]))
        polygons = polygon_arrays.to_polygons(np.array([footprint], dtype=object))
        point = crop_cloud(cloud, polygons, self.config.reconstruct.buffer_m).of(0)
        return np.column_stack([cloud.x_m[point], cloud.y_m[point], cloud.z_m[point]])

    def to_trimesh(self, skin: bool = False) -> trimesh.Scene:
        """All meshes, each under the id of its building.

        Parameters
        ----------
        skin : bool
            Whether the meshes of touching buildings become one closed mesh without the walls between them, under the
            id of the first building.

        Returns
        -------
        trimesh.Scene
            Vertices are in the CRS of the scene.
        """
        import trimesh

        result = trimesh.Scene(metadata={"crs": None if self.crs is None else self.crs.to_string()})
        for body in self._bodies(skin):
            result.add_geometry(body.mesh.to_trimesh(), node_name=body.name, geom_name=body.name)
        return result

    @checked
    def write(
        self, folder: str | Path, formats: Iterable[str] | None = None, name: str | None = None
    ) -> list[Path]:
        """Write files into a folder, and return their paths.

        Parameters
        ----------
        folder : path
        formats : sequence of str, optional
            The default is ``reconstruct.outputs`` of the config. A scene that was read from a file, and a copy, can
            only be written in mesh formats, without terrain.
        name : str, optional
            The name of the files without ending; by default the name of the scene.

        Returns
        -------
        list of Path

        Raises
        ------
        InputError
            If a file cannot be written, if no file would be, or if the folder does not exist and its name has the
            ending of a file.
        """
        settings = self.config.reconstruct
        if formats is not None:
            checked = load({"reconstruct": {"outputs": list(formats)}}).reconstruct.outputs
            settings = settings.model_copy(update={"outputs": checked})
        folder, name = Path(folder), name or self.name
        files.check_stem(name)
        files.check_folder(folder, OUTPUT_SUFFIXES.values())
        if settings.writes_parquet:  # an error after other files would be too late
            import pyarrow.parquet  # noqa: F401
        if self._run is not None:
            run = self._run
            terrain = run.inputs.terrain and run.inputs.terrain[0]
            results, crs = run.results, run.inputs.crs
            with run.failures.met():
                return exports.write(folder, name, results, crs, run.facts, settings, terrain, run.plants)
        others = [each for each in settings.outputs if each not in MESH_WRITERS]
        chosen = [each for each in dict.fromkeys(settings.outputs) if each in MESH_WRITERS]
        if others and (formats is not None or not chosen):
            raise InputError(
                f"{self.name}: {others[0]} needs a reconstruction; choose from {', '.join(MESH_WRITERS)}"
            )
        if others:
            log.warning(
                "warning: %s: without its run, it is written without %s", self.name, ", ".join(others)
            )
        scene = self.in_metres()
        bodies = scene._bodies(settings.skin)
        frame = frame_around(bodies, "" if scene.crs is None else scene.crs.to_string())
        materials = {"vegetation": settings.materials.vegetation}
        bodies += [
            Body.of_building(plant_id, each, materials)
            for plant_id, each in scene.plants.items()
            if len(each.triangle)
        ]
        return [
            path
            for each in chosen
            for path in exports.write_meshes(folder, name, each, bodies, frame, settings, {})
        ]

    def to_html(self) -> str:
        """The page of the scene: buildings in 3D and in a table, which needs no other file and no internet."""
        if self._run is None:
            # the page itself uses names such as points and ground, which a scene may have, too
            return page.page_of_scenes(self.name, {f"Meshes of {self.name}": self}, None)
        inputs = self._run.inputs
        terrain = inputs.terrain and inputs.terrain[0]
        keep, plants = self.config.reconstruct.keep_columns, [*self.plants.values()]
        return page.page_of_run(
            self._run.results, self.name, inputs.crs, self._run.facts, keep, plants, terrain
        )

    def _repr_html_(self) -> str:
        """The page of :meth:`to_html`, for a cell of a notebook."""
        return f'<iframe srcdoc="{html.escape(self.to_html())}" style="width:100%;height:46rem;border:0"></iframe>'

    def show(self) -> Path | None:
        """Show the page of the scene: in a notebook below the cell, and otherwise in the browser.

        Returns
        -------
        Path or None
            The temporary file that the browser shows; None in a notebook.
        """
        ipython = sys.modules.get("IPython")
        if ipython is not None and hasattr(ipython.get_ipython(), "kernel"):
            ipython.display.display(self)
            return None
        # importing it takes four milliseconds
        import webbrowser

        path = Path(tempfile.mkdtemp(prefix="p2wss-")) / "scene.html"
        files.write_text(path, self.to_html())
        webbrowser.open(path.as_uri())
        return path

    @public
    def plot(self, view: str = "oblique", *, ids: Sequence[str] | None = None, axes: Any = None) -> Any:
        """Draw the scene with matplotlib (the extra ``report``), and return the axes, on which more can be drawn.

        Parameters
        ----------
        view : {"oblique", "plan"}
            A plan is in the CRS of the scene, with footprints without a mesh in outline.
        ids : sequence of str, optional
            The ids of the buildings to draw; by default all.
        axes : optional
            The axes to draw on; by default new ones.

        Returns
        -------
        matplotlib.axes.Axes
        """
        if missing := [each for each in ids or () if each not in self]:
            raise InputError(f"{self.name}: has no building {missing[0]}")
        chosen = self.values() if ids is None else [self[each] for each in ids]
        return picture.plot(chosen, view, axes)

    @public
    def explore(self, column: str | None = "status", **options: Any) -> Any:
        """The footprints and their attributes on a web map (the extra ``map``).

        Parameters
        ----------
        column : str or None
            The attribute of :attr:`table` that colours them, None for one colour.
        **options
            Options of ``geopandas.GeoDataFrame.explore``.

        Returns
        -------
        folium.Map

        Raises
        ------
        InputError
            If no building has the attribute ``column``.
        """
        import folium  # noqa: F401 (an ImportError of geopandas would not tell the extra)

        table = self.table
        known = [name for name, values in table.drop(columns="geometry").items() if values.notna().any()]
        if column is not None and column not in known:
            raise InputError(f"column: choose from {', '.join(map(str, known))}, not {column!r}")
        return table.explore(column, **options)

    def explain(self, building_id: str) -> Explanation:
        """Why the roof of a building is as it is. The building is reconstructed once more.

        Parameters
        ----------
        building_id : str

        Returns
        -------
        Explanation
            ``print`` shows it as text, its ``plot()`` as a picture.

        Raises
        ------
        InputError
            For a scene that was read from a file, which has no points.
        """
        from p2wss.reconstruction import explain

        if self._run is None:
            raise InputError(f"{self.name}: has no points: it is a copy, or was read from a file")
        result = explain.explain(self._run.inputs, self.config, building_id)
        # its ground may be the ground of the nearest buildings, which are not reconstructed once more
        return result if result.planes else replace(result, building=self[building_id])

    def _bodies(self, skin: bool) -> list[Body]:
        settings = self.config.reconstruct
        bodies = [
            Body.of_building(
                each.building_id, each.solid, exports.surface_materials(each.attributes, settings)
            )
            for each in self.values()
            if each.solid is not None
        ]
        if not skin:
            return bodies
        return block_skins.skin_bodies(block_skins.joined(bodies), bodies)


@dataclass(frozen=True)
class Run:
    """What a scene keeps of its run. footprints: the cleaned footprint of each result, before the registration.
    results: in a temporary file. kept: the results with only the kept columns of the footprints. points: the cloud, in
    another temporary file. facts: the provenance. failures: what failed. resources: closed with the scene."""

    inputs: Inputs
    footprints: np.ndarray
    results: Sequence[Result]
    kept: Sequence[Result]
    plants: Sequence[vegetation.Plant]
    points: CloudIndex
    facts: dict[str, Any]
    failures: Failures
    resources: ExitStack


def of_run(run: Run, ids: Sequence[str], config: Config, name: str) -> Scene:
    """The scene of a run that is done. ids: of its buildings. name: of the files, without ending."""
    crowns = {plant.name: plant.mesh for plant in run.plants}
    return Scene(
        ids, lambda k: _of_result(run.kept[k], config, run.facts), run.inputs.crs, config, name, run, crowns
    )


def read(path: str | Path) -> Scene:
    """See :func:`p2wss.read`."""
    path = Path(path)
    objects, crs = cityjson_read.read_city(path)
    solids = [each for each in objects if each.is_building]
    plants = {
        each.building_id: replace(each.mesh, kind=np.full_like(each.mesh.kind, VEGETATION))
        for each in objects
        if not each.is_building
    }
    name = path.stem.removesuffix(".city")
    ids = [each.building_id for each in solids]
    return Scene(ids, lambda k: _of_file(solids[k]), crs, Config(), name, plants=plants)


def bounds_of(meshes: Sequence[Mesh]) -> Bounds | None:
    """x_min, y_min, x_max and y_max of meshes; None if they have no vertex."""
    xy = np.concatenate([np.zeros((0, 2)), *(mesh.vertex_m[:, :2] for mesh in meshes)])
    return bounds_of_points(*xy.T)


def as_registered(footprints: np.ndarray, numbers: np.ndarray, results: Sequence[Result]) -> np.ndarray:
    """The footprints of a run, moved where the registration has moved them. numbers: the footprints of ``results``."""
    moved = footprints.copy()
    for number, result in zip(numbers.tolist(), results, strict=True):
        if result.registration is not None:
            moved[number] = shapely.transform(moved[number], partial(np.add, result.registration.shift_m))
    return moved


def _of_result(result: Result, config: Config, facts: Mapping[str, Any]) -> SceneBuilding:
    reconstruction = result.reconstruction
    rings = [ring + reconstruction.origin_xy_m for ring in reconstruction.rings]
    return SceneBuilding(
        reconstruction.building_id,
        result.status,
        result.reason,
        attributes(result, facts, config.reconstruct.attribute_names),
        shapely.Polygon(rings[0], rings[1:]) if rings else None,
        reconstruction.placed_mesh if reconstruction.has_mesh else None,
        reconstruction.surfaces,
    )


def _of_file(solid: cityjson_read.ReadSolid) -> SceneBuilding:
    mesh = solid.mesh if len(solid.mesh.triangle) else None
    ground = np.zeros((0, 3, 3)) if mesh is None else mesh.corner_m[mesh.kind == FaceKind.GROUND]
    footprint = shapely.union_all(shapely.polygons(ground[:, :, :2]))
    # in files of other programs, attributes of these names mean something else: in 3DBAG, the use of a building
    is_ours = solid.attributes.get("status") in STATUSES
    return SceneBuilding(
        solid.building_id,
        solid.attributes["status"] if is_ours else "ok" if mesh is not None else "none",
        solid.attributes.get("reason") if is_ours else None,
        solid.attributes,
        footprint if isinstance(footprint, shapely.Polygon) and len(ground) else None,
        mesh,
    )

"""A scene: the buildings of a run or of a CityJSON file, to be looked at, measured and written.

The results of a run stay in temporary files until the scene is closed or forgotten: a scene of a large area needs no
more memory than its points of one batch.
"""

from __future__ import annotations

import html
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj
import shapely

from p2wss.clouds.crops import crop_cloud
from p2wss.config import CLASSES_ALONE, OUTPUT_SUFFIXES, Config, DeviceName, load, section_json
from p2wss.data import polygon_arrays, reasons
from p2wss.data.crs import MetricCrs, metric_crs
from p2wss.data.las_classes import class_set
from p2wss.data.tiling import Bounds, bounds_of_points, grown
from p2wss.formats import cityjson_read
from p2wss.formats.cityjson import SURFACE_TYPE
from p2wss.formats.meshes import VEGETATION, Body, frame_around
from p2wss.formats.outputs import MESH_WRITERS
from p2wss.mesh import Mesh, faces
from p2wss.nets.threads import set_num_threads
from p2wss.reconstruction.area import (
    MARGIN_M,
    Area,
    chosen,
    cleaned,
    in_tile,
    read_features,
    run_area,
    window,
)
from p2wss.reconstruction.compiled import compile_once
from p2wss.reconstruction.inputs import Inputs, read_outlines
from p2wss.reconstruction.outputs import exports, page, picture, vegetation
from p2wss.reconstruction.outputs.attributes import attributes, table
from p2wss.reconstruction.pipeline import OWN_OUTLINE, Rows
from p2wss.reconstruction.points import ground, plausibility, unclassified
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.reconstruction.registration import register as registration
from p2wss.reconstruction.result import STATUSES, Result, summary
from p2wss.reconstruction.roof_lines import with_lines
from p2wss.reconstruction.running.failures import Failures
from p2wss.reconstruction.running.spool import Spool
from p2wss.reconstruction.skin import block_skins
from p2wss.skeleton.types import FaceKind
from p2wss.storage import files
from p2wss.storage.arguments import checked, public
from p2wss.storage.errors import InputError
from p2wss.storage.features import Features
from p2wss.storage.log_lines import log
from p2wss.storage.progress import Progress
from p2wss.storage.provenance import fingerprint
from p2wss.storage.temporary import Closeable

if TYPE_CHECKING:
    import geopandas as gpd
    import trimesh

    from p2wss.reconstruction.explain import Explanation
    from p2wss.reconstruction.network import Predictor


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
        ``flat`` is a flat roof instead, and ``none`` no mesh, for ``reason``.
    reason : str or None
    attributes : mapping
        As in the files, see docs/manual/attributes.md.
    footprint : Polygon or None
        On which the mesh stands, in the CRS of the scene: moved by the registration, with walls where the fit has put
        them. None if the file has none.
    solid : Mesh or None
        In the CRS of the scene; None without one.
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
        Of all coordinates; None for a file that states none.
    config : Config
    name : str
    plants : mapping of Mesh
        Closed volumes, of ``--vegetation``, by their ids.
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
        """A copy, or a scene of another process, has the buildings, but not the run with its points."""
        building = list(self.values()).__getitem__
        return Scene, (list(self), building, self.crs, self.config, self.name, None, self.plants)

    @property
    def bounds(self) -> Bounds | None:
        """x_min, y_min, x_max and y_max of all meshes, in the CRS of the scene; None without any."""
        return bounds_of([each.solid for each in self.values() if each.solid is not None])

    def converted(self, metric: MetricCrs) -> Scene:
        """The scene of a file in ``metric.source`` with its meshes in ``metric.crs``, without footprints."""

        def building(number: int) -> SceneBuilding:
            each = self._building(number)
            solid = None if each.solid is None else metric.mesh(each.solid)
            return replace(each, solid=solid, footprint=None, _polygons=())

        plants = {name: metric.mesh(plant) for name, plant in self.plants.items()}
        return Scene(list(self), building, metric.crs, self.config, self.name, plants=plants)

    def in_metres(self) -> Scene:
        """The scene of a file, in the CRS that a run on clouds in its CRS has: files of meshes and surveys are in
        metres."""
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
        """A row per building, by its id: footprint and attributes."""
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
        (footprint,) = _as_registered(self._run.footprints[number], np.zeros(1, int), results)
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
            Whether those of touching buildings become one closed mesh without the walls between them, under the id of
            the first building.

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
            From ``reconstruct.outputs`` of the config, which is the default. Of a scene that was read from a file, and
            of a copy, only mesh formats, without terrain.
        name : str, optional
            Of the files, without ending.

        Returns
        -------
        list of Path

        Raises
        ------
        InputError
            If a file cannot be written, none would be, or the folder is not there and is named as a file.
        """
        settings = self.config.reconstruct
        if formats is not None:
            checked = load({"reconstruct": {"outputs": list(formats)}}).reconstruct.outputs
            settings = settings.model_copy(update={"outputs": checked})
        folder, name = Path(folder), name or self.name
        files.check_stem(name)
        files.check_folder(folder, OUTPUT_SUFFIXES.values())
        if settings.writes_parquet:  # or no file is
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
            # the page has names of its own, such as points and ground
            return page.page_of_scenes(self.name, {f"Meshes of {self.name}": self}, None)
        inputs = self._run.inputs
        terrain = inputs.terrain and inputs.terrain[0]
        keep, plants = self.config.reconstruct.keep_columns, [*self.plants.values()]
        return page.page_of_run(
            self._run.results, self.name, inputs.crs, self._run.facts, keep, plants, terrain
        )

    def _repr_html_(self) -> str:
        """That page in a cell of a notebook."""
        return f'<iframe srcdoc="{html.escape(self.to_html())}" style="width:100%;height:46rem;border:0"></iframe>'

    def show(self) -> Path | None:
        """Show the page of the scene: in a notebook below the cell, and otherwise in the browser.

        Returns
        -------
        Path or None
            Of the temporary file that the browser shows.
        """
        ipython = sys.modules.get("IPython")
        if ipython is not None and hasattr(ipython.get_ipython(), "kernel"):
            ipython.display.display(self)
            return None
        # four milliseconds of each start
        import webbrowser

        path = Path(tempfile.mkdtemp(prefix="p2wss-")) / "scene.html"
        files.write_text(path, self.to_html())
        webbrowser.open(path.as_uri())
        return path

    @public
    def plot(self, view: str = "oblique", *, ids: Sequence[str] | None = None, axes: Any = None) -> Any:
        """A picture by matplotlib (the extra ``report``): the axes, on which more can be drawn.

        Parameters
        ----------
        view : {"oblique", "plan"}
            A plan is in the CRS of the scene, with footprints without a mesh in outline.
        ids : sequence of str, optional
            Of the buildings to draw; by default all.
        axes : optional
            To draw on; by default new ones.

        Returns
        -------
        matplotlib.axes.Axes
        """
        chosen = self.values() if ids is None else [self[each] for each in ids]
        return picture.plot(chosen, view, axes)

    @public
    def explore(self, column: str | None = "status", **options: Any) -> Any:
        """The footprints on a map of the web, with their attributes (the extra ``map``).

        Parameters
        ----------
        column : str or None
            The attribute of :attr:`table` that colours them, None for one colour.
        **options
            Of ``geopandas.GeoDataFrame.explore``.

        Returns
        -------
        folium.Map

        Raises
        ------
        InputError
            For an attribute that no building has.
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
        # its ground may be that of others, which are not reconstructed once more
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
    """What a scene keeps of its run. footprints: of the results, cleaned, before the registration. results: in a
    temporary file. kept: the same with the columns of footprints that are kept. points: the cloud, in another file.
    facts: of the provenance. failures: what failed. resources: what is closed with the scene."""

    inputs: Inputs
    footprints: np.ndarray
    results: Sequence[Result]
    kept: Sequence[Result]
    plants: Sequence[vegetation.Plant]
    points: CloudIndex
    facts: dict[str, Any]
    failures: Failures
    resources: ExitStack


@dataclass(frozen=True)
class Selection:
    """Which buildings are reconstructed: those of these ids, with their centre in ``bbox`` (in the CRS of the run), and
    with it in the tile of this name, which may have none. None of the three limits nothing."""

    ids: Sequence[str] | None = None
    bbox: Bounds | None = None
    tile: str | None = None


@dataclass(frozen=True)
class Machine:
    """Where a run computes. device: of the network. threads: of the network, or processes of the fit without
    one. scratch: folder of temporary files."""

    device: DeviceName = "auto"
    threads: int = 1
    scratch: Path | None = None


def reconstruct(
    inputs: Inputs,
    config: Config,
    selection: Selection = Selection(),
    machine: Machine = Machine(),
    progress: bool | Callable[[int, int], object] = True,
) -> Scene:
    """See :func:`p2wss.reconstruct`."""
    failures = Failures(config.reconstruct.strict)
    with failures.met(), ExitStack() as resources:
        completion = config.reconstruct.completion and inputs.completion
        settings = config.reconstruct.model_copy(update={"completion": completion})
        config, tile = config.model_copy(update={"reconstruct": settings}), selection.tile
        predictor = load_network(inputs.weights, machine.device, machine.threads)
        terrain = None if inputs.terrain is None else inputs.terrain[0]
        outline_cloud = None
        if inputs.footprints is None:
            outline_cloud, features, is_own = read_outlines(inputs, config)
            features = features.having(**{OWN_OUTLINE: np.full(len(features), is_own)})
        else:
            features = read_features(inputs, settings)
        log.debug("%d footprints read", len(features))
        compile_once()
        whole = set(features["building_id"].tolist())
        features = cleaned(features, config)
        log.debug("%d footprints cleaned", len(features))
        if inputs.lines is not None:
            features = with_lines(features, inputs.lines[0])
        is_chosen = in_tile(features, tile, config.region.tile_size_m)
        is_chosen &= chosen(features, whole, selection.ids, selection.bbox, inputs.footprints_name)
        area = Area(features, is_chosen, settings)
        folder = machine.scratch or Path(tempfile.gettempdir())
        rows, boxes, around = features.take(area.is_chosen), area.boxes, None
        if settings.vegetation and len(rows):
            around = grown(shapely.total_bounds(rows.geometry).tolist(), settings.terrain_margin_m)
            boxes = np.concatenate([boxes, [grown(around, vegetation.RULES.margin_m)]])
        points = resources.enter_context(CloudIndex(boxes, folder, adds_classes=outline_cloud is None))
        store = resources.enter_context(Spool[Any](2 * len(area.numbers), folder))
        if outline_cloud is None:
            if tile is None and len(rows) and shapely.is_empty(rows.geometry).all():
                raise InputError(_none_usable(rows, inputs))
            if tile is None and not inputs.overlap(window(features)):
                raise InputError(_no_overlap(len(features), inputs))
            for chunk in inputs.chunks(points.bounds, class_set(**config.region.classes.model_dump())):
                points.append(chunk)
            points.drop_repeated()
            for warning in unclassified.warnings(*area.missing_classes(points)):
                log.warning("warning: %s", warning)
        else:
            points.append(outline_cloud)
            outline_cloud = None
        registers = area.registers(points)
        if inputs.footprints is None:
            registers[:] = registration.STAYS
        elif settings.registration == "always":
            registers[:] = registration.CLASSES
        if inputs.terrain is not None:
            exports.check_coverage(*inputs.terrain, rows)
        if points.num_points:
            sample = plausibility.sample_of(rows, points, terrain)
            log.info("%s", plausibility.summary(sample))
            plausibility.check(sample, inputs, settings.height_unit, settings.terrain_unit)
        for note in exports.notes(settings, rows, terrain is not None):
            log.info("note: %s", note)
        method = f"model {inputs.weights}" if inputs.weights else "fit to the points"
        log.info("%d footprints, %d points around them; %s", len(rows), points.num_points, method)
        stem = tile or inputs.name
        with _reporting(progress, len(area.numbers)) as report:
            to_do = Rows(
                len(area.numbers), store, predictor, stem, settings, terrain, machine.threads, folder
            )
            run_area(area, points, to_do, registers, report)
        results = store[: len(rows)]
        if registers[area.is_chosen].any():
            log.info("%s", registration.summary(result.registration for result in results))
        if (
            (selection.ids or tile) is None
            and inputs.footprints is not None
            and not any(r.num_points for r in results)
        ):
            raise InputError(_no_overlap(len(results), inputs, points.num_points))
        num_unseen = sum(r.ground is not None and r.ground[0] in ground.UNSEEN for r in results)
        if num_unseen:
            log.warning(
                "warning: no ground is seen around %d of %d buildings; it is guessed from the lowest points"
                " (ground_source), often too high%s",
                num_unseen,
                len(results),
                "" if terrain else "; --terrain states it",
            )
        facts = files.provenance(
            config=section_json(config, "region", "scenes", "reconstruct", without=CLASSES_ALONE),
            code=fingerprint("reconstruction"),
            crs=inputs.crs.to_string(),
            model=inputs.weights and inputs.weights.name,
            clouds=[header.path.name for header in inputs.headers],
            footprints=None if inputs.footprints is None else inputs.footprints_name.name,
            **({} if inputs.lines is None else {"lines": inputs.lines[1]}),
            terrain=None if inputs.terrain is None else inputs.terrain[1].name,
        )
        plants: list[vegetation.Plant] = []
        if around is not None:
            footprints = _as_registered(features.geometry, area.numbers, store[: len(area.numbers)])
            plants = vegetation.plants(points, around, footprints)
            log.info("%d plants", len(plants))
        kept = exports.kept(results, settings)
        run = Run(inputs, rows.geometry, results, kept, plants, points, facts, failures, resources.pop_all())

    ids = rows["building_id"].tolist()
    crowns = {plant.name: plant.mesh for plant in plants}
    return Scene(ids, lambda k: _of_result(kept[k], config, facts), inputs.crs, config, stem, run, crowns)


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
    """x_min, y_min, x_max and y_max of meshes; None without a vertex."""
    xy = np.concatenate([np.zeros((0, 2)), *(mesh.vertex_m[:, :2] for mesh in meshes)])
    return bounds_of_points(*xy.T)


def load_network(weights: Path | None, device: DeviceName = "auto", threads: int = 1) -> Predictor | None:
    """The network of a file of weights, with so many threads; None for none. torch is imported here and not before."""
    if weights is None:
        return None
    set_num_threads(threads)
    from p2wss.nets.predictor import load_predictor

    return load_predictor(weights, device)


@contextmanager
def _reporting(
    progress: bool | Callable[[int, int], object], total: int
) -> Iterator[Callable[[int], object]]:
    """What is called with the number of buildings that are done."""
    if progress is True:
        with Progress("reconstruct", total, "buildings") as bar:
            yield bar.update
    else:
        yield lambda num_done: progress(num_done, total) if callable(progress) else None


def _as_registered(footprints: np.ndarray, numbers: np.ndarray, results: Sequence[Result]) -> np.ndarray:
    """All footprints of a run, those of ``numbers``, which have results, where the registration has moved them."""
    moved = footprints.copy()
    for number, result in zip(numbers.tolist(), results, strict=True):
        if result.registration is not None:
            moved[number] = shapely.transform(moved[number], partial(np.add, result.registration.shift_m))
    return moved


def _none_usable(rows: Features, inputs: Inputs) -> str:
    counts = Counter(rows["status"].tolist()).most_common()
    reasons_text = "; ".join(
        f"{reason}: {count} ({reasons.MEANINGS.get(reason, reason)})" for reason, count in counts
    )
    words = f"{inputs.footprints_name}: none of its {len(rows)} footprints can be built: {reasons_text}"
    are_degrees = (np.abs([rows["centre_x_m"], rows["centre_y_m"]]) <= [[180], [90]]).all()
    return f"{words}; their coordinates look like degrees: save them with their CRS" if are_degrees else words


def _no_overlap(num_footprints: int, inputs: Inputs, num_points: int = 0) -> str:
    if num_points:
        return (
            f"{inputs.headers[0].path}: has {num_points} points around the {num_footprints} footprints of"
            f" {inputs.footprints_name}, but none on them: are points of buildings missing, or footprints displaced?"
        )
    return (
        f"{inputs.headers[0].path}: no point near any of the {num_footprints} footprints of {inputs.footprints_name}:"
        " do they cover the same place, in the same CRS? Noise, withheld points and ignored classes do not count"
    )


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
    # other programs' attributes of these names mean other things, as in 3DBAG the use of a building
    is_ours = solid.attributes.get("status") in STATUSES
    return SceneBuilding(
        solid.building_id,
        solid.attributes["status"] if is_ours else "ok" if mesh is not None else "none",
        solid.attributes.get("reason") if is_ours else None,
        solid.attributes,
        footprint if isinstance(footprint, shapely.Polygon) and len(ground) else None,
        mesh,
    )

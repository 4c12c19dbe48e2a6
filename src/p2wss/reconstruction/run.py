"""A run: from checked inputs to a scene, by the stations that concern all buildings."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from p2wss.clouds.reading import Cloud
from p2wss.config import CLASSES_ALONE, Config, DeviceName, section_json
from p2wss.data import reasons
from p2wss.data.las_classes import class_set
from p2wss.data.tiling import Bounds, grown
from p2wss.nets.threads import set_num_threads
from p2wss.reconstruction.area import Area, chosen, cleaned, in_tile, read_features, run_area, window
from p2wss.reconstruction.compiled import compile_once
from p2wss.reconstruction.inputs import Inputs, read_outlines
from p2wss.reconstruction.outputs import exports, vegetation
from p2wss.reconstruction.pipeline import OWN_OUTLINE, Rows
from p2wss.reconstruction.points import ground, plausibility, unclassified
from p2wss.reconstruction.points.cloud_index import CloudIndex
from p2wss.reconstruction.registration import register as registration
from p2wss.reconstruction.result import Result
from p2wss.reconstruction.roof_lines import with_lines
from p2wss.reconstruction.running.failures import Failures
from p2wss.reconstruction.running.spool import Spool
from p2wss.reconstruction.scene import Run, Scene, as_registered, of_run
from p2wss.storage import files
from p2wss.storage.features import Features
from p2wss.storage.messages import InputError, log
from p2wss.storage.progress import Progress
from p2wss.storage.provenance import fingerprint

if TYPE_CHECKING:
    from p2wss.reconstruction.product import Predictor


@dataclass(frozen=True)
class Selection:
    """Which buildings are reconstructed: buildings that meet all conditions that are not None.

    ids: the ids of buildings. bbox: contains the centre of the footprint; in the CRS of the run. tile: the name of the
    tile that contains the centre; it may be a tile without buildings."""

    ids: Sequence[str] | None = None
    bbox: Bounds | None = None
    tile: str | None = None


@dataclass(frozen=True)
class Machine:
    """Where a run computes. device: of the network. threads: threads of the network, or without a network, processes of
    the fit. scratch: folder for temporary files; None: the folder of the system."""

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
        features, outline_cloud = _features(inputs, config)
        compile_once()
        area = _area(features, inputs, config, selection)
        rows, boxes, around = area.features.take(area.is_chosen), area.boxes, None
        if settings.vegetation and len(rows):
            around = grown(shapely.total_bounds(rows.geometry).tolist(), settings.terrain_margin_m)
            boxes = np.concatenate([boxes, [grown(around, vegetation.RULES.margin_m)]])
        folder = machine.scratch or Path(tempfile.gettempdir())
        points = resources.enter_context(CloudIndex(boxes, folder, adds_classes=outline_cloud is None))
        store = resources.enter_context(Spool[Any](2 * len(area.numbers), folder))
        if outline_cloud is not None:
            points.append(outline_cloud)
            outline_cloud = None
        elif tile is None and (text := _unusable(rows, inputs, area)):
            raise InputError(text)
        else:
            _read_points(points, inputs, area, config)
        registers = _registers(area, points, inputs, settings.registration)
        _look(inputs, config, rows, points)
        stem = tile or inputs.name
        with _reporting(progress, len(area.numbers)) as report:
            to_do = Rows(
                len(area.numbers), store, predictor, stem, settings, terrain, machine.threads, folder
            )
            run_area(area, points, to_do, registers, report)
        results = store[: len(rows)]
        if registers[area.is_chosen].any():
            log.info("%s", registration.summary(result.registration for result in results))
        is_whole = (selection.ids or tile) is None and inputs.footprints is not None
        if is_whole and not any(each.num_points for each in results):
            raise InputError(_no_overlap(len(results), inputs, points.num_points))
        _warn_of_unseen_ground(results, terrain is not None)
        plants: list[vegetation.Plant] = []
        if around is not None:
            footprints = as_registered(area.features.geometry, area.numbers, store[: len(area.numbers)])
            plants = vegetation.plants(points, around, footprints)
            log.info("%d plants", len(plants))
        kept, facts = exports.kept(results, settings), _facts(inputs, config)
        run = Run(inputs, rows.geometry, results, kept, plants, points, facts, failures, resources.pop_all())
    return of_run(run, rows["building_id"].tolist(), config, stem)


def load_network(weights: Path | None, device: DeviceName = "auto", threads: int = 1) -> Predictor | None:
    """The network with these weights, or None without weights. threads: threads of torch, which is imported only
    here."""
    if weights is None:
        return None
    set_num_threads(threads)
    from p2wss.nets.predictor import load_predictor

    return load_predictor(weights, device)


def _features(inputs: Inputs, config: Config) -> tuple[Features, Cloud | None]:
    """(the footprints, None), or without footprints (outlines of the buildings in the cloud, the whole cloud)."""
    cloud = None
    if inputs.footprints is None:
        cloud, features, is_own = read_outlines(inputs, config)
        features = features.having(**{OWN_OUTLINE: np.full(len(features), is_own)})
    else:
        features = read_features(inputs, config.reconstruct)
    log.debug("%d footprints read", len(features))
    return features, cloud


def _area(features: Features, inputs: Inputs, config: Config, selection: Selection) -> Area:
    """The footprints, cleaned and with the lines of their roofs, and which of them are chosen."""
    whole = set(features["building_id"].tolist())
    features = cleaned(features, config)
    log.debug("%d footprints cleaned", len(features))
    if inputs.lines is not None:
        features = with_lines(features, inputs.lines[0])
    is_chosen = in_tile(features, selection.tile, config.region.tile_size_m)
    is_chosen &= chosen(features, whole, selection.ids, selection.bbox, inputs.footprints_name)
    return Area(features, is_chosen, config.reconstruct)


def _unusable(rows: Features, inputs: Inputs, area: Area) -> str:
    """Why no footprint of a run can be built, as known before points are read; else empty."""
    if len(rows) and shapely.is_empty(rows.geometry).all():
        return _none_usable(rows, inputs)
    return "" if inputs.overlap(window(area.features)) else _no_overlap(len(area.features), inputs)


def _read_points(points: CloudIndex, inputs: Inputs, area: Area, config: Config) -> None:
    counts = np.zeros(256, np.int64)
    for chunk in inputs.chunks(points.bounds, class_set(**config.region.classes.model_dump())):
        points.append(chunk)
        counts += np.bincount(chunk.classification, minlength=256)
    points.drop_repeated()
    unknown = unclassified.warnings_of_unknown(counts)
    for warning in (*unclassified.warnings(*area.missing_classes(points)), *unknown):
        log.warning("warning: %s", warning)


def _registers(area: Area, points: CloudIndex, inputs: Inputs, setting: str) -> np.ndarray:
    """int8 (footprints,): whether each footprint may be moved (:meth:`Area.registers`), by the setting of the user."""
    registers = area.registers(points)
    if inputs.footprints is None:
        registers[:] = registration.STAYS
    elif setting == "always":
        registers[:] = registration.CLASSES
    return registers


def _look(inputs: Inputs, config: Config, rows: Features, points: CloudIndex) -> None:
    """Says what a run is about to do, and refuses what cannot be right, before the work."""
    settings, terrain = config.reconstruct, inputs.terrain
    if terrain is not None:
        exports.check_coverage(*terrain, rows)
    if points.num_points:
        sample = plausibility.sample_of(rows, points, terrain and terrain[0])
        log.info("%s", plausibility.summary(sample))
        plausibility.check(sample, inputs, settings.height_unit, settings.terrain_unit)
    for note in exports.notes(settings, rows, terrain is not None):
        log.info("note: %s", note)
    method = f"model {inputs.weights}" if inputs.weights else "fit to the points"
    log.info("%d footprints, %d points around them; %s", len(rows), points.num_points, method)


def _warn_of_unseen_ground(results: Sequence[Result], has_terrain: bool) -> None:
    num_unseen = sum(each.ground is not None and each.ground[0] in ground.UNSEEN for each in results)
    if num_unseen:
        log.warning(
            "warning: no ground is seen around %d of %d buildings; it is guessed from the lowest points"
            " (ground_source), often too high%s",
            num_unseen,
            len(results),
            "" if has_terrain else "; --terrain states it",
        )


def _facts(inputs: Inputs, config: Config) -> dict[str, Any]:
    """The provenance of a run: config, code, CRS and files."""
    return files.provenance(
        config=section_json(config, "region", "scenes", "reconstruct", without=CLASSES_ALONE),
        code=fingerprint("reconstruction"),
        crs=inputs.crs.to_string(),
        model=inputs.weights and inputs.weights.name,
        clouds=[header.path.name for header in inputs.headers],
        footprints=None if inputs.footprints is None else inputs.footprints_name.name,
        **({} if inputs.lines is None else {"lines": inputs.lines[1]}),
        terrain=None if inputs.terrain is None else inputs.terrain[1].name,
    )


@contextmanager
def _reporting(
    progress: bool | Callable[[int, int], object], total: int
) -> Iterator[Callable[[int], object]]:
    """Yields a function to call with the number of buildings that are done. progress: True shows a progress bar, a
    function is called with the number and with ``total``, False does nothing."""
    if progress is True:
        with Progress("reconstruct", total, "buildings") as bar:
            yield bar.update
    else:
        yield lambda num_done: progress(num_done, total) if callable(progress) else None


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

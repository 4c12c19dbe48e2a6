"""Why a roof is as it is: the planes that its points show, the lines between planes, and what each price decided."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from p2wss.config import Config
from p2wss.fit.fitting import TRACE
from p2wss.fit.planes.costs import FORBIDDEN_M3
from p2wss.fit.planes.detection import distances
from p2wss.fit.planes.fit import PlanesFit
from p2wss.fit.planes.labelling import least_cost
from p2wss.fit.planes.solid import OUTSIDE
from p2wss.reconstruction import run
from p2wss.reconstruction.inputs import Inputs
from p2wss.reconstruction.outputs.picture import plot
from p2wss.reconstruction.scene import SceneBuilding
from p2wss.skeleton.angles import slope_angles
from p2wss.storage.messages import InputError, log

# a plane that is not used is tried in cells in which it has more than this share of the points
_MOST = 0.5
# with more planes, the roof without each plane is not computed: the time grows with the square of their number
_MAX_COMPARED = 300


@dataclass(frozen=True)
class Explanation:
    """A building and how its planes were chosen.

    planes: the fit whose solid is written; None for a parametric building, a flat roof, or no mesh. num_fits: number of
    fits of planes; more than one if a solid was not valid.
    """

    building: SceneBuilding
    planes: PlanesFit | None
    num_fits: int

    def __str__(self) -> str:
        facts, reason = self.building.attributes, f" ({self.building.reason})" if self.building.reason else ""
        text = [f"{self.building.building_id}: {self.building.status}{reason}, method {facts['method']}"]
        if self.planes is None:
            return "\n".join(
                [
                    *text,
                    "no planes were fitted: too few points, no valid solid below them, or the parametric building was "
                    "asked for",
                ]
            )
        if self.num_fits > 1:
            text.append(f"fitted {self.num_fits} times with higher prices, as the solid before was not valid")
        return "\n".join([*text, *_planes(self.planes), *_prices(self.planes)])

    def plot(self) -> Any:
        """A figure of matplotlib (the extra ``report``) with three pictures: the points by plane; the lines, and the
        borders of the planes that are used; the building."""
        from matplotlib import pyplot
        from matplotlib.collections import LineCollection
        from matplotlib.colors import to_rgba

        figure, (left, middle, right) = pyplot.subplots(1, 3, figsize=(15, 5), layout="constrained")
        plot([self.building], "oblique", right)
        if self.planes is None:
            return figure
        fit, colors = self.planes, pyplot.get_cmap("tab20")
        color = np.where(fit.at_plane[:, None] < 0, to_rgba("#bbbbbb"), colors(fit.at_plane % 20))
        left.scatter(*fit.point_m[:, :2].T, s=3, color=color)
        for number in np.unique(fit.built[fit.built != OUTSIDE]).tolist():
            own = fit.built == number
            place_m = np.average(fit.cells.middle_m[own], axis=0, weights=fit.cells.area_m2[own])
            middle.annotate(str(number), place_m, color=colors(number % 20), weight="bold", ha="center")
        beside = np.append(fit.built, OUTSIDE)[fit.cells.pair]
        is_border, end_m = beside[:, 0] != beside[:, 1], fit.cells.xy_m[fit.cells.side]
        middle.add_collection(LineCollection(end_m[~is_border], colors="#cccccc", linewidths=0.5))
        middle.add_collection(LineCollection(end_m[is_border], colors="#222222", linewidths=1.5))
        for axes, title in (
            (left, "points by plane, grey: of none"),
            (middle, "lines (grey), planes that are used"),
        ):
            axes.add_collection(LineCollection(end_m[(fit.cells.pair < 0).any(axis=1)], colors="#222222"))
            axes.autoscale_view()
            axes.set_aspect("equal")
            axes.set(title=title, xlabel="x (m)", ylabel="y (m)")
        return figure


def _planes(fit: PlanesFit) -> Iterator[str]:
    """A line of text per plane, under two lines of titles."""
    # cell -1: points on roofs around
    cell = fit.cells.cells_at(fit.point_m[:, :2])
    is_built = fit.built != OUTSIDE
    area_m2 = np.bincount(fit.built[is_built], fit.cells.area_m2[is_built], len(fit.plane))
    num_points = np.count_nonzero(is_built[cell[cell >= 0]])
    yield f"{(area_m2 > 0).sum()} of {len(fit.plane)} planes are used; {num_points} points on {area_m2.sum():.0f} m2"
    yield f"{'plane':>5} {'points':>7} {'m2':>7} {'slope':>6} {'faces':>6} {'off, m':>7}  without it"
    for number, plane in enumerate(fit.plane):
        own = (fit.at_plane == number) & (cell >= 0)
        off_m = distances(plane[None], fit.point_m[own]).mean() if own.any() else np.nan
        slope = float(slope_angles(np.hypot(*plane[:2])))
        bearing = (
            f"{(450 - np.degrees(np.arctan2(-plane[1], -plane[0]))) % 360:.0f}" if slope > 0.5 else "level"
        )
        name = f"{number}*" if number >= len(fit.plane) - fit.num_known else str(number)
        yield (
            f"{name:>5} {own.sum():>7} {area_m2[number]:>7.1f} {slope:>6.1f} {bearing:>6} {off_m:>7.3f}  "
            f"{_saving(fit, number, cell, own) if len(fit.plane) <= _MAX_COMPARED else 'too many planes'}"
        )
    if fit.num_known:
        yield "* of a roof that a network supposes, the parametric building, or of lines of a map: there are few points"


def _saving(fit: PlanesFit, number: int, cell: np.ndarray, own: np.ndarray) -> str:
    """A text: what a used plane saves, or what an unused plane would cost if it were used. cell: (m,), the cell of each
    point, -1 outside. own: bool (m,), the points of the plane inside the building."""
    problem, total_m3 = fit.costs.problem, fit.costs.total_m3(fit.label)
    if (fit.label == number).any():
        if not (fit.built == number).any():
            return "open ground: outside the building"
        barred_m3 = np.where(problem.number == number, FORBIDDEN_M3, problem.cell_m3)
        without = replace(fit.costs, problem=problem._replace(cell_m3=barred_m3))
        more_m3 = without.total_m3(least_cost(without, fit.num_known)) - total_m3
        return "nothing else is near" if more_m3 > FORBIDDEN_M3 / 2 else f"{more_m3:+.2f} m3"
    if number >= len(fit.plane) - fit.num_known:
        return "not used"
    num, num_own = (np.bincount(each, minlength=len(fit.label)) for each in (cell[cell >= 0], cell[own]))
    label = np.where(num_own > _MOST * num, number, fit.label)
    if (label == fit.label).all():
        return "not used: no cell has most of its points"
    return f"not used: {fit.costs.total_m3(label) - total_m3:+.2f} m3 if it were"


def _prices(fit: PlanesFit) -> Iterator[str]:
    """Lines of text: how many lines between planes are used, and the parts of the cost of the roof."""
    inner = (fit.cells.pair >= 0).all(axis=1)
    beside, line = fit.label[fit.cells.pair[inner]], fit.cells.line[inner]
    num_used = len(np.unique(line[beside[:, 0] != beside[:, 1]]))
    yield f"lines: {len(fit.cells.lines)} along which planes may end, of which {num_used} divide planes"
    total_m3 = fit.costs.total_m3(fit.label)
    parts = {}
    for name, price in (("faces", "face_m3"), ("edges", "edge_m2"), ("lines with steps", "line_m3")):
        free = replace(fit.costs, prices=fit.costs.prices._replace(**{price: 0.0}))
        parts[name] = total_m3 - free.total_m3(fit.label)
    parts = {"points off the planes": total_m3 - sum(parts.values()), **parts}
    yield f"cost {total_m3:.2f} m3: {', '.join(f'{name} {each:.2f}' for name, each in parts.items())}"


def explain(inputs: Inputs, config: Config, building_id: str) -> Explanation:
    """Reconstruct one building as a run does, and keep what was chosen on the way. The limit of triangles is ignored,
    as it applies to all buildings of a run together.

    Raises :class:`InputError` if no footprint has this id, or if only its parts are built, which have ids of their own.
    """
    if config.reconstruct.max_triangles is not None:
        log.info(
            "note: reconstruct.max_triangles is of a whole run, which may have this building at detail low"
        )
        settings = config.reconstruct.model_copy(update={"max_triangles": None})
        config = config.model_copy(update={"reconstruct": settings})
    trace: list[tuple[str, PlanesFit | None]] = []
    token = TRACE.set(trace)
    try:
        selection, here = run.Selection(ids=[building_id]), run.Machine(threads=0)
        with run.reconstruct(inputs, config, selection, here, progress=False) as result:
            if building_id not in result:
                raise InputError(f"{building_id}: is in parts; choose from {', '.join(result)}")
            building = result[building_id]
    finally:
        TRACE.reset(token)
    # the trace has its neighbours, too, which are built with it
    fits = [planes for each, planes in trace if each == building_id]
    return Explanation(building, fits[-1] if fits and building.status == "ok" else None, len(fits))

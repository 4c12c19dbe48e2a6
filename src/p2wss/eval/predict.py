"""Our own variants on the test split and on real LiDAR: the network alone, and the product with and without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from p2wss.config import Reconstruct
from p2wss.data.building import Building, Reconstruction
from p2wss.eval.cases import Case
from p2wss.eval.clock import CpuClock
from p2wss.reconstruct.network import Predictor, reconstruct_with_network
from p2wss.reconstruct.product import method_name, reconstruct_buildings
from p2wss.storage.schemas.crops import REAL, SIMULATED

_NUM_WARM_UP = 10
Method = Callable[[Sequence[Building], Reconstruct], list[Reconstruction]]


def for_dataset(config: Reconstruct, dataset: str) -> Reconstruct:
    """The settings for a data set.

    Simulated buildings have a single eave height and no dormers. For real buildings the settings of the product are
    used as they are.
    """
    if dataset != SIMULATED:
        return config
    return config.model_copy(update={"max_parts": 1, "dormers": False})


def predict(
    cases: Sequence[Case], predictor: Predictor, config: Reconstruct, clock: CpuClock | None = None
) -> list[Reconstruction]:
    """The network's reconstructions with the views of its training, one per case, in order (the paper's method).

    A case that the network cannot reconstruct has no mesh, not a flat roof.
    """

    def network(buildings: Sequence[Building], settings: Reconstruct) -> list[Reconstruction]:
        return reconstruct_with_network(buildings, predictor, settings)

    return by_dataset(cases, network, config, clock)


def fit(
    cases: Sequence[Case],
    predictor: Predictor | None,
    config: Reconstruct,
    clock: CpuClock | None = None,
) -> list[Reconstruction]:
    """The result of ``p2wss reconstruct`` for each case, in order: fitted from the network (method ``point2wss+fit``)
    or, without a predictor, from the points alone (``fit``).

    A flat roof that the product falls back to counts as the method's, with the reason as its status.
    """
    config = config.model_copy(update={"fit": True})
    method = method_name(predictor, config)

    def product(buildings: Sequence[Building], settings: Reconstruct) -> list[Reconstruction]:
        rows = reconstruct_buildings(buildings, predictor, settings)
        return [replace(row, method=method) for row in rows]

    return by_dataset(cases, product, config, clock)


def by_dataset(
    cases: Sequence[Case], method: Method, config: Reconstruct, clock: CpuClock | None = None
) -> list[Reconstruction]:
    """``method(buildings, settings)`` for each data set with its settings (:func:`for_dataset`), in order of cases."""
    by_row: dict[int, Reconstruction] = {}
    for dataset in (SIMULATED, REAL):
        rows = [i for i, case in enumerate(cases) if case.dataset == dataset]
        if not rows:
            continue
        buildings, settings = [cases[i].building for i in rows], for_dataset(config, dataset)
        if clock is None:
            reconstructions = method(buildings, settings)
        else:
            # compilation and loading, even of code that few buildings need, count for no building
            if not clock.has_timed(dataset):
                method(buildings[:_NUM_WARM_UP], settings)
            with clock.timed(dataset, len(rows)):
                reconstructions = method(buildings, settings)
        by_row |= dict(zip(rows, reconstructions, strict=True))
    return [by_row[i] for i in range(len(cases))]

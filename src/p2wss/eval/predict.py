"""Our own variants on the test split and on real LiDAR: the network, with and without the fit, and the fit alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from p2wss.config import Reconstruct
from p2wss.data.building import Building, Reconstruction, no_mesh
from p2wss.data.schemas.crops import REAL, SIMULATED
from p2wss.eval.cases import Case
from p2wss.eval.clock import CpuClock
from p2wss.fit import fitting
from p2wss.reconstruct.network import Predictor, reconstruct_with_network

NETWORK, FIT = "point2wss", fitting.METHOD
NETWORK_AND_FIT = f"{NETWORK}+{FIT}"
_NUM_WARM_UP = 10
Method = Callable[[Sequence[Building], Reconstruct], list[Reconstruction]]


def for_dataset(config: Reconstruct, dataset: str) -> Reconstruct:
    """Simulated buildings keep their footprint, to which the labels belong, and their one height; real
    footprints are simplified, and real buildings may have parts."""
    if dataset != SIMULATED:
        return config
    return config.model_copy(update={"simplify_m": 0.0, "max_parts": 1})


def predict(
    cases: Sequence[Case], predictor: Predictor, config: Reconstruct, clock: CpuClock | None = None
) -> list[Reconstruction]:
    """The network's reconstructions, one per case, in order."""
    return by_dataset(
        cases, lambda buildings, own: reconstruct_with_network(buildings, predictor, own), config, clock
    )


def fit(
    cases: Sequence[Case],
    predictions: Mapping[tuple[str, str, str], Reconstruction] | None,
    config: Reconstruct,
    clock: CpuClock | None = None,
) -> list[Reconstruction]:
    """Reconstructions fitted to the points, one per case, in order.

    They begin with ``predictions``, the network's, by the key of their case (method ``point2wss+fit``), or with
    nothing (method ``fit``)."""
    if predictions is None:
        return by_dataset(cases, lambda buildings, own: fitting.fit(buildings, own), config, clock)
    starts = {
        id(case.building): predictions.get(case.key) or no_mesh(case.building, NETWORK, "not run")
        for case in cases
    }
    return by_dataset(
        cases,
        lambda buildings, own: fitting.fit(
            buildings, own, [starts[id(b)] for b in buildings], NETWORK_AND_FIT
        ),
        config,
        clock,
    )


def by_dataset(
    cases: Sequence[Case], method: Method, config: Reconstruct, clock: CpuClock | None = None
) -> list[Reconstruction]:
    """``method(buildings, config)`` for each data set with its own config; in the order of the cases."""
    found: dict[int, Reconstruction] = {}
    for dataset in (SIMULATED, REAL):
        rows = [i for i, case in enumerate(cases) if case.dataset == dataset]
        if not rows:
            continue
        buildings, own = [cases[i].building for i in rows], for_dataset(config, dataset)
        if clock is None:
            made = method(buildings, own)
        else:
            # what is compiled or loaded once counts for no building, also what only a few of them need
            method(buildings[:_NUM_WARM_UP], own)
            with clock.timed(dataset, len(rows)):
                made = method(buildings, own)
        found |= dict(zip(rows, made, strict=True))
    return [found[i] for i in range(len(cases))]

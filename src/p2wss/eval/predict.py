"""The network on the test split and on real LiDAR: reconstructions, and the errors of Table 1."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from p2wss.config import Reconstruct
from p2wss.eval.cases import LIDAR, SYNTHETIC, Case
from p2wss.reconstruct import Building, Predictor, Reconstruction, reconstruct

Method = Callable[[Sequence[Building], Reconstruct], list[Reconstruction]]


def for_dataset(config: Reconstruct, dataset: str) -> Reconstruct:
    """Simulated buildings keep their footprint, to which the labels belong; real ones are simplified."""
    return config.model_copy(update={"simplify_m": 0.0}) if dataset == SYNTHETIC else config


def predict(cases: Sequence[Case], predictor: Predictor, config: Reconstruct) -> list[Reconstruction]:
    """One reconstruction per case, in order."""
    return by_dataset(cases, lambda buildings, own: reconstruct(buildings, predictor, own), config)


def by_dataset(cases: Sequence[Case], method: Method, config: Reconstruct) -> list[Reconstruction]:
    """``method(buildings, config)`` for each data set with its own config; in the order of the cases."""
    found: dict[int, Reconstruction] = {}
    for dataset in (SYNTHETIC, LIDAR):
        rows = [i for i, case in enumerate(cases) if case.dataset == dataset]
        if rows:
            made = method([cases[i].building for i in rows], for_dataset(config, dataset))
            found |= dict(zip(rows, made, strict=True))
    return [found[i] for i in range(len(cases))]

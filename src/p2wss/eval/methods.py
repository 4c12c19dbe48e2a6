"""Our methods among those of an evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from p2wss.data.building import Reconstruction
from p2wss.reconstruct.product import FIT, NETWORK, NETWORK_AND_FIT


def main_method(methods: Sequence[str]) -> str:
    """Our best variant: the network with the fit if it was run, else the network, else the fit alone."""
    return next((name for name in (NETWORK_AND_FIT, NETWORK, FIT) if name in methods), NETWORK)


def fit_parts(reconstructions: Mapping[str, Reconstruction | None]) -> int:
    """Number of parts of a building by the fit, 1 where it was not run. reconstructions: of the building, by method."""
    for method in (NETWORK_AND_FIT, FIT):
        reconstruction = reconstructions.get(method)
        if reconstruction is not None and reconstruction.has_mesh:
            return reconstruction.num_parts
    return 1

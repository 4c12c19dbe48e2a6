"""What ``p2wss warm-up`` compiles is what ``p2wss reconstruct`` calls."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

import numpy as np
from numba.core.registry import CPUDispatcher

import p2wss.fit
from p2wss.clouds import cropping
from p2wss.config import Reconstruct
from p2wss.nets import supposed
from p2wss.reconstruction import warm_up
from p2wss.reconstruction.pipeline import run

# called from Python by tests only
NOT_CALLED = {"inherited_angles"}


def entries() -> Iterator[CPUDispatcher]:
    """The compiled functions of the fit and of the cropping that Python calls."""
    names = [module.name for module in pkgutil.walk_packages(p2wss.fit.__path__, "p2wss.fit.")]
    for module in (*map(importlib.import_module, names), cropping, supposed):
        for function in vars(module).values():
            if isinstance(function, CPUDispatcher) and function.py_func.__module__ == module.__name__:
                options = function.targetoptions
                if not options.get("no_cpython_wrapper") and options.get("inline") != "always":
                    yield function


def test_everything_that_is_called_from_python_gets_compiled() -> None:
    warm_up.warm_product()
    missing = {each.py_func.__name__ for each in entries() if not each.signatures}
    assert missing <= NOT_CALLED


def test_the_sample_has_a_step_a_dormer_and_a_courtyard() -> None:
    frame, cloud = warm_up.sample()
    any_shape, parametric = (
        [result.reconstruction for result in run(frame, cloud, None, "sample", Reconstruct(roofs=roofs))]
        for roofs in ("planes", "parametric")
    )
    assert any_shape[0].num_parts == 2
    assert len(any_shape[1].mesh.triangle) > len(parametric[1].mesh.triangle)
    assert len(any_shape[2].rings) == 2 and np.isfinite(any_shape[2].mesh.vertex_m).all()

"""The kind of roof that a recipe of CONTRIBUTING adds, run as it stands there."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
import shapely
from manifold3d import Manifold

from p2wss.fit.mesh.union import is_sound, union
from p2wss.fit.parts import kinds, parts
from p2wss.fit.parts.partition import fit_parts
from p2wss.fit.parts.roofs import Roof
from p2wss.fit.roof.fitter import Fitter, kernel_solid
from p2wss.fit.settings import Cutting, Effort, Limits

PAGE = Path(__file__).parents[4] / "CONTRIBUTING.md"
RING = np.array([[0, 0], [10, 0], [10, 10], [0, 10.0]])


def test_the_dome_of_the_recipe_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    _, recipe = PAGE.read_text().split("## Recipe: add a kind of roof to a part")
    code = "from __future__ import annotations\n" + "".join(
        dedent(block)
        for block in re.findall(r"```python\n(.*?)   ```", recipe.split("## Recipe")[0], re.DOTALL)
    )
    names = {
        "dataclass": dataclass, "replace": replace, "np": np, "shapely": shapely, "Manifold": Manifold, "Roof": Roof,
        "kernel_solid": kernel_solid, "__name__": __name__,
    }  # fmt: skip
    exec(code, names)
    monkeypatch.setattr(parts, "KINDS", (*kinds.KINDS, names["dome"]))
    rng = np.random.default_rng(0)
    xy_m = rng.uniform(0, 10, (1500, 2))
    z = 6 + np.sqrt(np.maximum(25 - ((xy_m - 5) ** 2).sum(axis=1), 0)) + 0.02 * rng.standard_normal(1500)
    (roof,) = fit_parts(Fitter(Limits()), [RING], np.column_stack([xy_m, z]), Effort(), Cutting())
    assert type(roof).__name__ == "Dome" and roof.loss_m < 0.02
    assert roof.eave_z_m == pytest.approx(6.0, abs=0.02)
    mesh = union([roof], 1.0, 12.0)
    assert mesh is not None and is_sound(mesh)
    assert mesh.vertex_m[:, 2].max() == pytest.approx(11.0, abs=0.05)

"""The roof of a part, as the rest of the fit sees it. CONTRIBUTING.md shows how to add another kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import manifold3d
import numpy as np

if TYPE_CHECKING:
    from p2wss.fit.roof.fitter import Fitter


@dataclass(frozen=True)
class Roof(ABC):
    """A roof over a polygon: of a building, a part of one, or a box.

    rings: each (n, 2), exterior first. angle_deg: one per edge, rings in order: 0, 90 or 5 to 75; of another kind of
    roof those that resemble it most. eave_z_m: the lowest, above the ground like all z. loss_m: mean over the points
    of min(|distance to the roof|, cap), plus the cost of a prior.
    """

    rings: Sequence[np.ndarray]
    angle_deg: np.ndarray
    eave_z_m: float
    loss_m: float
    num_points: int

    @property
    def total_loss_m(self) -> float:
        return self.loss_m * self.num_points

    @property
    def slope_rings(self) -> Sequence[np.ndarray]:
        """Where slopes begin: the rings of the kernel's roof that is nearest to this one."""
        return self.rings

    @property
    def is_level_at_eaves(self) -> bool:
        """Whether the eave height and the angles describe all of it, as in the paper."""
        return False

    @property
    @abstractmethod
    def num_slopes(self) -> int:
        """How many sloped faces it is charged for."""

    @abstractmethod
    def height_over(self, point_m: np.ndarray, fitter: Fitter) -> tuple[np.ndarray, np.ndarray]:
        """(its height, z of its unit normal) over each point (m, 3); minus infinity and 1 beside it. fitter: whose
        work arrays may be used."""

    @abstractmethod
    def solid(self, min_eave_height_m: float, max_roof_height_m: float) -> manifold3d.Manifold | None:
        """The closed solid from the ground up to the roof; None if there is none. Walls on
        the rings have exactly their coordinates."""

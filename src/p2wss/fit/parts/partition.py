"""The partition of a footprint into parts: the search for the one that costs least.

What a partition costs is the sum of the residuals, and a price for each part and each slope (:class:`PartFitter`). The
footprint is cut up; then two parts become one, as long as that costs less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from p2wss.fit.parts.parts import Part, PartFitter
from p2wss.fit.parts.roofs import Roof
from p2wss.fit.points import even_order
from p2wss.fit.roof.fitter import Fitter
from p2wss.fit.roof.work import NO_PRIOR, Prior
from p2wss.fit.settings import Cutting, Effort


def fit_parts(
    fitter: Fitter,
    rings: Sequence[np.ndarray],
    point_m: np.ndarray,
    effort: Effort,
    cutting: Cutting,
    guesses: Sequence[np.ndarray] = (),
    prior: Prior = NO_PRIOR,
) -> list[Roof]:
    """The parts of a building: one if no cut gains enough, none if no roof can be fitted. Everything is in the frame
    of ``rings``, which is that of :func:`p2wss.fit.parts.parts.main_frame`; vertices on a cut have exactly its
    coordinate.

    effort: of the whole building. guesses, prior: of the whole building, too.
    """
    point_m = point_m[even_order(point_m)] if len(point_m) else point_m
    part_fitter = PartFitter(fitter, effort, cutting, len(point_m))
    whole = part_fitter.whole(rings, point_m, guesses, prior)
    if whole is None:
        return []
    search = _Search(part_fitter, whole)
    search.cut()
    while search.merge():
        pass
    own_prior = prior if len(search.parts) == 1 else NO_PRIOR
    return [part_fitter.final_roof(part, own_prior) for part in search.parts]


@dataclass(frozen=True)
class _Cut:
    """The two sides of a cut, None for no cut. gain_m: of the cut, and of the second one that it needs."""

    gain_m: float
    sides: tuple[Part, Part] | None


_NO_CUT = _Cut(0.0, None)


class _Search:
    """The parts so far, and what is known of pairs of them: the two as one part."""

    def __init__(self, part_fitter: PartFitter, whole: Part) -> None:
        self.parts = [whole]
        self._fitter = part_fitter
        self._cuts: dict[Part, _Cut] = {}
        self._merged: dict[frozenset[Part], Part | None] = {}

    def cut(self) -> None:
        """Cuts parts, the cut that gains most first, as long as a cut gains a share of what a part costs, alone or with
        a second one. Mergers undo those that do not pay in the end."""
        while len(self.parts) < self._fitter.cutting.max_parts:
            for part in self.parts:
                if part not in self._cuts:
                    self._cuts[part] = self._best_cut(part)
            part = max(self.parts, key=lambda part: self._cuts[part].gain_m)
            sides = self._cuts[part].sides
            if sides is None:
                return
            self._merged[frozenset(sides)] = part
            place = self.parts.index(part)
            self.parts[place : place + 1] = sides

    def _best_cut(self, part: Part) -> _Cut:
        """The best cut of a part. An annex in a corner needs two cuts, and the first alone gains nothing; so where much
        remains to be gained, a cut may lose a little if a second one makes up for it."""
        cutting, price_m = self._fitter.cutting, self._fitter.price_m
        min_gain_m, min_excess_m = cutting.over_share * price_m, cutting.look_ahead_share * price_m
        looks_ahead = cutting.loss_share > 0 and part.excess_m >= min_excess_m
        sides = self._fitter.cut(part, -cutting.loss_share * price_m if looks_ahead else min_gain_m)
        if sides is None:
            return _NO_CUT
        gain_m = _gain_m([part], sides)
        if gain_m >= min_gain_m:
            return _Cut(gain_m, sides)
        for side in sides:
            if side.excess_m >= min_excess_m:
                second = self._fitter.cut(side, price_m - gain_m)
                if second is not None:
                    self._cuts[side] = _Cut(_gain_m([side], second), second)
                    return _Cut(gain_m + self._cuts[side].gain_m, sides)
        return _NO_CUT

    def merge(self) -> bool:
        """Makes those two parts one for which that saves most. Returns whether there are any."""
        best_gain_m, best = 0.0, None
        for pair in combinations(reversed(self.parts), 2):
            key = frozenset(pair)
            if key not in self._merged:
                self._merged[key] = self._fitter.merged(*pair)
            merged = self._merged[key]
            if merged is not None:
                gain_m = _gain_m(pair, [merged]) + self._fitter.price_m
                if gain_m > best_gain_m:
                    best_gain_m, best = gain_m, (pair, merged)
        if best is None:
            return False
        pair, merged = best
        self.parts = [part for part in self.parts if part not in pair] + [merged]
        return True


def _gain_m(before: Sequence[Part], after: Sequence[Part]) -> float:
    """What parts cost less than others, without the prices of parts."""
    return sum(part.cost_m for part in before) - sum(part.cost_m for part in after)

"""One building once: footprints that are there twice, lie in others, or are the outline of parts."""

import logging
import shlex
from collections import Counter, defaultdict
from dataclasses import replace

import numpy as np
import shapely

from p2wss.data import reasons
from p2wss.storage.features import Features
from p2wss.storage.messages import log

# column with the ids of the footprints that a footprint overlaps; None if there are none
COLUMN = "overlapping_ids"
# a narrower overlap is of neighbours, and is divided between them by p2wss.footprints.coverage
_NARROW_M = 0.5
# a footprint is in another one that covers this share of it; parts make up an outline if they cover this share of it
_WITHIN_SHARE, _PARTS_SHARE = 0.9, 0.9
# a footprint is not built if others cover more than this share of it; else its rest is built where it is this wide
_COVERED_SHARE, _REST_WIDTH_M = 2 / 3, 2.0
# a footprint larger than this is no building if this many others are in it
_LARGEST_M2, _NUM_INSIDE = 500_000.0, 3
_NUM_NAMED = 3


def without_overlaps(features: Features) -> tuple[Features, np.ndarray]:
    """(the footprints without overlaps, so that each place belongs to one; bool (n,), whether a footprint takes the
    place of others that are not built).

    features: as :func:`p2wss.footprints.cleaning.split_parts` returns them. An outline that is covered by its parts is
    not built, but the parts (:data:`~p2wss.data.reasons.HAS_PARTS`); parts without a stated height get the height that
    the outline states. A footprint larger than any building is not built, but the footprints in it
    (:data:`~p2wss.data.reasons.AROUND_OTHERS`). Otherwise the larger one of two footprints stays as it is, and the
    smaller one keeps what is outside it. If that is little, it gets the status :data:`~p2wss.data.reasons.DUPLICATE` or
    :data:`~p2wss.data.reasons.WITHIN_OTHER`. Footprints that are not built have an empty polygon. The column
    ``overlapping_ids`` names the other footprints, as words of a shell.

    The result of a footprint depends only on the footprints that it overlaps, directly or through others, not on the
    order of the rows.
    """
    status, shapes = features["status"].copy(), features.geometry.copy()
    ids = features["building_id"].tolist()
    pairs, common_m2 = _wide_overlaps(shapes, status == reasons.OK)
    is_covering = np.zeros(len(ids), bool)
    if not len(pairs):
        return features, is_covering
    area_m2 = shapely.area(shapes)
    beside: defaultdict[int, dict[int, float]] = defaultdict(dict)
    for (a, b), common in zip(pairs.tolist(), common_m2.tolist(), strict=True):
        beside[a][b] = beside[b][a] = common
    others = np.full(len(ids), None, object)
    height_m = features.columns.get("stated_height_m", np.full(len(ids), np.nan)).copy()
    bounds = shapely.bounds(shapes)
    # of equal footprints, the one with the first id is built, as a repeated id has a suffix
    ascending = sorted(
        sorted(beside, key=ids.__getitem__, reverse=True), key=lambda k: (area_m2[k], *bounds[k])
    )
    for k in ascending:
        inside = [
            each
            for each, common in beside[k].items()
            if status[each] == reasons.OK
            and common > _WITHIN_SHARE * area_m2[each]
            and area_m2[each] < _WITHIN_SHARE * area_m2[k]
        ]
        parts = _parts(k, inside, shapes, area_m2)
        if not parts and area_m2[k] > _LARGEST_M2 and len(inside) >= _NUM_INSIDE:
            status[k] = reasons.AROUND_OTHERS
            others[k] = shlex.join(sorted(ids[each] for each in inside))
        if parts:
            status[k] = reasons.HAS_PARTS
            is_covering[parts] = True
            height_m[parts] = np.where(np.isnan(height_m[parts]), height_m[k], height_m[parts])
            others[k] = shlex.join(sorted(ids[part] for part in parts))
    done: set[int] = set()
    for k in reversed(ascending):
        if status[k] != reasons.OK:
            continue
        over = [other for other in beside[k] if other in done]
        done.add(k)
        if not over:
            continue
        others[k] = shlex.join(sorted(ids[other] for other in over))
        rest = shapely.difference(shapes[k], shapely.union_all(shapes[over]))
        # without lines that may be left, with which GEOS finds no intersection
        rest = shapely.MultiPolygon([each for each in shapely.get_parts(rest) if each.geom_type == "Polygon"])
        wide = rest.buffer(-_REST_WIDTH_M / 2, join_style="mitre").buffer(
            _REST_WIDTH_M / 2, join_style="mitre"
        )
        pieces = shapely.get_parts(shapely.intersection(wide, rest))
        is_polygon = shapely.get_type_id(pieces) == shapely.GeometryType.POLYGON
        pieces = pieces[is_polygon & ~shapely.is_empty(pieces)]
        if rest.area < (1 - _COVERED_SHARE) * area_m2[k] or not len(pieces):
            is_same = any(beside[k][each] > _COVERED_SHARE * area_m2[each] for each in over)
            status[k] = reasons.DUPLICATE if is_same else reasons.WITHIN_OTHER
            is_covering[over] = True
            done.discard(k)
        else:
            shapes[k] = max(pieces, key=shapely.area)
    shapes[status != reasons.OK] = shapely.Polygon()
    columns = {"status": status, "stated_height_m": height_m, COLUMN: others}
    return replace(features.having(**columns), geometry=shapes), is_covering


def _wide_overlaps(shapes: np.ndarray, is_usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(pairs of usable footprints that overlap by more than neighbours do, (n, 2); the common area of each pair)."""
    row = np.flatnonzero(is_usable)
    first, second = shapely.STRtree(shapes[row]).query(shapes[row], predicate="intersects")
    pairs = row[np.column_stack([first, second])[first < second]]
    common = shapely.intersection(shapes[pairs[:, 0]], shapes[pairs[:, 1]])
    large = np.flatnonzero(shapely.area(common) > _NARROW_M**2 / 2)
    wide = large[~shapely.is_empty(shapely.buffer(common[large], -_NARROW_M / 2))]
    return pairs[wide], shapely.area(common[wide])


def _parts(outline: int, parts: list[int], shapes: np.ndarray, area_m2: np.ndarray) -> list[int]:
    """The footprints ``parts``, which lie in an outline, if they are its parts: several that cover it, without covering
    a place twice; else an empty list."""
    together_m2 = shapely.union_all(shapes[parts]).intersection(shapes[outline]).area
    is_covered = together_m2 > _PARTS_SHARE * area_m2[outline]
    is_once = area_m2[parts].sum() < together_m2 / _PARTS_SHARE
    return parts if len(parts) > 1 and is_covered and is_once else []


def tell(features: Features) -> None:
    """Log how many footprints are not built, or only in part, because of overlaps, for each reason."""
    if COLUMN not in features.columns:
        return
    ids, status, others = features["building_id"].tolist(), features["status"], features[COLUMN]
    texts = {
        reasons.HAS_PARTS: "gave way to their parts",
        reasons.AROUND_OTHERS: "are larger than any building, and give way to those in them",
        reasons.DUPLICATE: "are there twice, and are built once",
        reasons.WITHIN_OTHER: "are within others, and are not built",
        reasons.OK: "overlap larger ones, and are built without the overlap",
    }
    for reason, text in texts.items():
        rows = [k for k in range(len(ids)) if status[k] == reason and others[k] is not None]
        if rows:
            names = ", ".join(ids[k] for k in rows[:_NUM_NAMED]) + ", .." * (len(rows) > _NUM_NAMED)
            is_usual = reason == reasons.HAS_PARTS
            level, prefix = (logging.INFO, "note") if is_usual else (logging.WARNING, "warning")
            if reason == reasons.WITHIN_OTHER:
                (most, _), *_ = Counter(name for k in rows for name in shlex.split(others[k])).most_common()
                names += f"; most in {most}: leave it out if it is no building"
            log.log(level, "%s: footprints that %s: %d (%s)", prefix, text, len(rows), names)

"""Records of the work arrays, and labels of faces. One set of arrays, sized for the largest polygon, serves a batch."""

from typing import NamedTuple

import numpy as np

from p2wss.skeleton.compiled import inner

MAX_EDGES = 4096

# One footprint edge: it starts at (x, y), local metres, and moves inwards at `speed` metres of plan per metre
# of height. `final_speed` is cot(angle); `speed` differs from it while the 0 degree edges sweep (phase 0).
EDGE = np.dtype(
    [
        ("x", "f8"),
        ("y", "f8"),
        ("dir_x", "f8"),
        ("dir_y", "f8"),
        ("length", "f8"),
        ("angle_deg", "f8"),
        ("speed", "f8"),
        ("final_speed", "f8"),
        ("prev", "i8"),
        ("next", "i8"),
    ],
    align=True,
)

# A node of the skeleton. z is the height above the eave. Nodes 0..num_edges-1 are the footprint's corners.
NODE = np.dtype([("x", "f8"), ("y", "f8"), ("z", "f8")], align=True)

# A vertex of the moving wavefront: it leaves `node` at height `birth` between the edges `left` (arriving) and
# `right` (departing). `collapse_time`: the height at which the piece of wavefront up to `next` vanishes.
# `split_time`: the height at which this reflex vertex runs into the piece `split_from` -> `split_to`.
VERTEX = np.dtype(
    [
        ("vel_x", "f8"),
        ("vel_y", "f8"),
        ("birth", "f8"),
        ("collapse_time", "f8"),
        ("split_time", "f8"),
        ("split_from", "i8"),
        ("split_to", "i8"),
        ("left", "i8"),
        ("right", "i8"),
        ("prev", "i8"),
        ("next", "i8"),
        ("node", "i8"),
        ("loop", "i8"),
        ("kind", "i8"),
        ("alive", "i8"),
        ("reflex", "i8"),
    ],
    align=True,
)

# An arc of the skeleton, from node `start` to node `end`, with the face on either side. A face number below
# num_edges is the roof of that edge; num_edges + c is the c-th horizontal cap.
ARC = np.dtype([("start", "i8"), ("end", "i8"), ("left", "i8"), ("right", "i8")], align=True)

# Indices into `counts`
NUM_NODES, NUM_ARCS, NUM_CAPS, NUM_VERTICES, NUM_LOOPS, NUM_HOLES, NUM_ALIVE, NUM_AMBIGUOUS, NUM_COUNTS = (
    range(9)
)


class SkeletonWork(NamedTuple):
    """Arrays that :func:`p2wss.skeleton.kinetic.simulate` reads and fills, for polygons of up to
    ``max_edges``."""

    edge: np.ndarray
    node: np.ndarray
    vertex: np.ndarray
    arc: np.ndarray
    cap_height: np.ndarray
    counts: np.ndarray


# A directed edge of a face of the solid. alive: 0 cancelled, 1 free, 2 part of a ring.
HALF = np.dtype(
    [
        ("start", "i8"),
        ("end", "i8"),
        ("label", "i8"),
        ("alive", "i8"),
        ("next_in_label", "i8"),
        ("next_out", "i8"),
    ],
    align=True,
)

# A face of the solid: rings ``ring_order[first_ring:last_ring]``, the outer one first.
FACE = np.dtype([("label", "i8"), ("first_ring", "i8"), ("last_ring", "i8")], align=True)


class Batch(NamedTuple):
    """A batch for compiled code: ragged polygons as in :class:`p2wss.skeleton.types.Polygons`, the angle of each edge,
    and for each polygon the heights of eave and base and the greatest height of the roof above the eave."""

    xy_m: np.ndarray
    ring_offset: np.ndarray
    polygon_offset: np.ndarray
    angle_deg: np.ndarray
    eave_height_m: np.ndarray
    base_height_m: np.ndarray
    max_roof_height_m: np.ndarray


class Corners(NamedTuple):
    """Corners of the rings of a face: uv, float64 (n, 2), in the plane of the face, and the numbers of the points."""

    uv: np.ndarray
    point: np.ndarray


class Ears(NamedTuple):
    """The corners before and after each corner of a ring that is cut into triangles, and the quality of its ear."""

    before: np.ndarray
    after: np.ndarray
    quality: np.ndarray


class MeshWork(NamedTuple):
    """Arrays for faces, triangles and checks of one solid."""

    point: np.ndarray
    parent: np.ndarray
    label_parent: np.ndarray
    label_head: np.ndarray
    out_head: np.ndarray
    place: np.ndarray
    place_x: np.ndarray
    place_y: np.ndarray
    near: np.ndarray
    ahead: np.ndarray
    half: np.ndarray
    ring: Corners
    ring_start: np.ndarray
    ring_order: np.ndarray
    ring_area: np.ndarray
    face: np.ndarray
    loop: Corners
    spare: Corners
    joined: np.ndarray
    ears: Ears
    triangle: np.ndarray
    triangle_label: np.ndarray
    new_index: np.ndarray
    twin: np.ndarray
    vertex: np.ndarray
    start: np.ndarray
    end: np.ndarray
    slot: np.ndarray
    corner: np.ndarray


# Labels of the faces of a solid, one for every plane of roof, cap, wall, flat piece and ground: 0..num_edges-1 are roof
# faces, by edge; then come the caps, the walls, by edge, all flat pieces at the eave under one label, and the ground.


@inner
def num_labels(num_edges: int, counts: np.ndarray) -> int:
    return 2 * num_edges + counts[NUM_CAPS] + 2


@inner
def wall_label(num_edges: int, counts: np.ndarray, e: int) -> int:
    return num_edges + counts[NUM_CAPS] + e


@inner
def flat_label(num_edges: int, counts: np.ndarray) -> int:
    return 2 * num_edges + counts[NUM_CAPS]


@inner
def ground_label(num_edges: int, counts: np.ndarray) -> int:
    return 2 * num_edges + counts[NUM_CAPS] + 1

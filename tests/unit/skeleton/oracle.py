"""Run as a program: volume and mean roof height of buildings by SFCGAL, whose crashes stay in this process.

Reads a pickled list of (rings, angles per ring) from standard input, writes one line of JSON per building:
its number and volume below the roof, or null. GPL software, for tests only.
"""

from __future__ import annotations

import json
import pickle
import sys
import time

import numpy as np


def roof_volume(rings: list, angles: list) -> float | None:
    """Volume between the eave plane and the roof."""
    from pysfcgal.geometry import Polygon

    # SFCGAL's angle i belongs to the edge that arrives at vertex i
    turned = [np.roll(np.asarray(a, float), 1).tolist() for a in angles]
    closed = [np.concatenate([r, r[:1]]).tolist() for r in rings]
    polygon = Polygon(closed[0], closed[1:])
    solid = polygon.extrude_straight_skeleton_with_angles(1e6, turned)
    if solid is None:
        return None
    volume = 0.0
    for face in solid.to_coordinates():
        ring = np.asarray(face[0], float)[:-1]
        rest = [np.asarray(r, float)[:-1] for r in face[1:]]
        if np.ptp(ring[:, 2]) == 0 and ring[0, 2] == 0:
            continue  # the base
        for r in (ring, *rest):  # volume below a plane polygon, fan by fan
            a, b, c = r[0], r[1:-1], r[2:]
            plan = (b[:, 0] - a[0]) * (c[:, 1] - a[1]) - (b[:, 1] - a[1]) * (c[:, 0] - a[0])
            volume += float(np.sum(0.5 * plan * (a[2] + b[:, 2] + c[:, 2]) / 3))
    return volume


if __name__ == "__main__":
    cases = pickle.load(sys.stdin.buffer)
    first = int(sys.argv[1])
    start = time.process_time()
    for number in range(first, len(cases)):
        print(json.dumps([number, None, 0.0]), flush=True)  # in advance, in case SFCGAL crashes
        before = time.process_time()
        try:
            volume = roof_volume(*cases[number])
        except Exception:
            volume = None
        print(json.dumps([number, volume, time.process_time() - before]), flush=True)

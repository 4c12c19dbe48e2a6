"""The picture of a scan shows its points in the colours that the legend names."""

import numpy as np
from matplotlib.colors import to_rgb
from toy_scene import TILE, TILE_SIZE_M, houses, table, terrain

from p2wss.config import Scans
from p2wss.scans import scan as scans
from p2wss.scans.picture import GROUND_COLOR, TREE_COLOR, densest_place, scan_figure
from p2wss.scans.surface import las_classes


def test_two_panels_show_the_points_of_the_window():
    settings = Scans(density_per_m2=6, density_bounds_per_m2=(6, 6))
    scan = scans.simulate(table(houses()), terrain(), TILE, TILE_SIZE_M, settings)
    middle = densest_place(scan.points)
    figure = scan_figure(scan.points, middle)
    near = np.abs(scan.points.xyz_mm[:, :2] / 1000 - middle).max(axis=1) < 35
    assert near.sum() > 1000
    colors = [axes.collections[0].get_facecolors()[:, :3] for axes in figure.axes]
    assert [len(c) for c in colors] == [near.sum()] * 2
    ground = (np.abs(colors[0] - to_rgb(GROUND_COLOR)) < 1e-6).all(axis=1).sum()
    trees = (np.abs(colors[0] - to_rgb(TREE_COLOR)) < 1e-6).all(axis=1).sum()
    classes = las_classes(scan.points.face)[near]
    assert (ground, trees) == ((classes == 2).sum(), (classes == 5).sum()) and trees > 0
    assert len(np.unique(colors[1], axis=0)) == len(np.unique(scan.points.strip[near]))


def test_a_scan_without_buildings_has_a_densest_place_too():
    scan = scans.simulate(table([]), terrain(), TILE, TILE_SIZE_M, Scans(density_per_m2=5))
    assert set(scan.facts["clutter"].values()) == {0}
    assert densest_place(scan.points).tolist() == [0, 0]

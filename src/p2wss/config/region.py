"""Section region: the area and its tiles."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from p2wss.config.base import Section

# stands for all names of tiles
ALL = "all"
# settings on which no tile depends: which other tiles are processed
TILE_LISTS = ("tiles", "lidar_tiles")
# settings on which only readers of real clouds depend, not footprints, terrain, downloads and scenes
OF_CLOUDS = ("classes", "members.*.region.classes")
# settings to leave out where only the classes of the clouds matter: in a run on files of a user
CLASSES_ALONE = (*TILE_LISTS, "name", "vintage", "crs", "bounds_m", "tile_size_m")
# France in tiles of 1 km fills a square of about a million
_MAX_TILES = 2_000_000
# the farthest coordinate of any projected CRS on Earth
_FARTHEST_M = 1e8

ClassPreset = Literal["las", "lidarhd", "ahn", "swisstopo", "ea", "custom"]


class Classes(Section):
    """Class codes of building, ground and ignored points, for crops and reconstruct.

    Points of all other classes may be on a building that the classifier has missed.
    """

    preset: ClassPreset = Field(
        "las", description="class codes of a producer, see p2wss.data.las_classes; custom = the lists below"
    )
    building: list[int] = Field([6], description="with preset custom: class codes of buildings")
    ground: list[int] = Field([2], description="with preset custom: class codes of ground")
    ignored: list[int] = Field(
        [7, 18], description="with preset custom: class codes to ignore, such as noise"
    )


class Region(Section):
    """The area to process, divided into tiles."""

    name: str = Field(
        "mini", pattern=r"^[A-Za-z0-9_-]+$", description="name of the region; results go to results/<name>"
    )
    vintage: str = Field(
        "mini",
        pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]*$",
        description="edition of the source data, which are stored in resources/ign/<vintage>",
    )
    crs: str = Field(
        "EPSG:2154",
        description="projected CRS in metres of tiles and results; the terrain must be in it, other inputs "
        "can be reprojected",
    )
    bounds_m: tuple[float, float, float, float] = Field(
        (652000, 6860000, 654000, 6862000), description="x_min, y_min, x_max, y_max of the region in the CRS"
    )
    tile_size_m: float = Field(
        1000, ge=10, le=10000, description="edge length of the square tiles; one scene per tile"
    )
    tiles: list[str] = Field(
        ["0652_6862", "0653_6862", "0652_6861"],
        description="tiles to process; [] = the tiles within the bounds that have buildings, [all] = all "
        "tiles within the bounds",
    )
    lidar_tiles: list[str] = Field(
        ["0653_6861"],
        description="tiles with real (or stand-in) LiDAR, for the evaluation and the dVAE; [] = none, [all] "
        "= the same tiles as in tiles",
    )
    classes: Classes = Classes()

    def shares_files(self, other: Region) -> bool:
        """Whether tiles of both regions may have the same name and vintage, by which terrain and clouds are stored."""
        (west, south, east, north), (x_min, y_min, x_max, y_max) = self.bounds_m, other.bounds_m
        overlaps = west < x_max and east > x_min and south < y_max and north > y_min
        return overlaps and (self.vintage, self.tile_size_m) == (other.vintage, other.tile_size_m)

    @field_validator("tiles", "lidar_tiles")
    @classmethod
    def _all_stands_alone(cls, names: list[str]) -> list[str]:
        if ALL in names and len(names) > 1:
            raise ValueError(f"{ALL} must be the only entry")
        return names

    @model_validator(mode="after")
    def _bounds_in_order(self) -> Self:
        x_min, y_min, x_max, y_max = self.bounds_m
        if x_min >= x_max or y_min >= y_max:
            raise ValueError("bounds_m must be x_min, y_min, x_max, y_max")
        if not all(abs(value) < _FARTHEST_M for value in self.bounds_m):
            raise ValueError("bounds_m must be metres in the CRS of the region")
        num_tiles = math.ceil((x_max - x_min) / self.tile_size_m) * math.ceil(
            (y_max - y_min) / self.tile_size_m
        )
        if num_tiles > _MAX_TILES:
            raise ValueError(
                f"bounds_m hold {num_tiles:,} tiles of tile_size_m {self.tile_size_m:g}; the largest number is"
                f" {_MAX_TILES:,}"
            )
        return self

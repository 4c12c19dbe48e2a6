"""Section scenes: tiles with clean footprints, heights and roof angles. Section buildings: their meshes from the
weighted straight skeleton."""

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section, Share, Shares


class RoofShares(Shares):
    """Relative frequency of each roof type; a type that is impossible on a footprint is replaced by the nearest one."""

    gable: float = Field(
        0.44, ge=0, description="two slopes with a gable at each end; each wing has its own gables"
    )
    hip: float = Field(0.18, ge=0, description="slopes on all sides")
    half_hip: float = Field(0.1, ge=0, description="one end hipped, the other a gable")
    shed: float = Field(0.06, ge=0, description="one slope")
    flat: float = Field(0.14, ge=0, description="no slope")
    mixed: float = Field(0.08, ge=0, description="an independent angle for each edge")


class Scenes(Section):
    """Stage scenes: cut tiles, clean footprints, draw missing heights and roof angles at random."""

    seed: int = Field(0, ge=0, description="seed of the random heights and roof angles")
    margin_m: float = Field(
        60,
        ge=0,
        description="width of the margin around a tile; its buildings are part of the scene because they may "
        "occlude the tile",
    )
    snap_m: float = Field(
        0.1,
        ge=0,
        le=0.5,
        description="gaps and overlaps between neighbouring footprints are closed up to this width; 0 = none",
    )
    simplify_m: float = Field(
        0.2,
        ge=0,
        le=5,
        description="Douglas-Peucker tolerance for simplifying footprints; 0 = no simplification",
    )
    min_edge_m: float = Field(0.1, ge=0.01, le=5, description="footprint edges shorter than this are removed")
    min_area_m2: float = Field(
        2,
        gt=0,
        description="footprints smaller than this are excluded, and courtyards smaller than this are filled",
    )
    max_edges: int = Field(1000, ge=3, le=5000, description="footprints with more edges are excluded")
    min_eave_height_m: float = Field(1.5, gt=0, description="eave heights below this count as unknown")
    max_eave_height_m: float = Field(
        99, gt=0, description="buildings with eaves above this height are excluded"
    )
    storey_height_m: float = Field(
        3,
        gt=0,
        description="height of a storey, for buildings with a known number of storeys but no known height",
    )
    min_terrain_share: Share = Field(
        0.5,
        description="footprints are excluded if terrain data cover less than this share of their perimeter",
    )
    sampler: Literal["realistic", "uniform", "uniform-kinds"] = Field(
        "realistic",
        description="realistic = draw a roof type and angles that produce it; uniform = draw each angle from "
        "0, 90 and 20 to 45, as in the paper; uniform-kinds = a third each of 0, 90 and any from 20 to 45",
    )
    roof_shares: RoofShares = RoofShares()
    max_rise_m: float = Field(
        7,
        gt=0,
        description="maximum rise of a roof above its eaves, which limits the angles of wide buildings",
    )
    max_failed_fraction: Share = Field(
        0.1,
        description="the job fails if a larger share of the footprints is excluded; footprints that are too "
        "small do not count",
    )


class Buildings(Section):
    """Stage buildings: closed meshes from the weighted straight skeleton."""

    max_roof_height_m: float = Field(
        12, gt=0, description="roofs that would rise further above the eaves are cut off horizontally"
    )
    max_failed_fraction: Share = Field(
        0.02, description="the job fails if a larger share of the buildings is rejected"
    )

"""Section scans: the simulated LiDAR survey."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from p2wss.config.base import HalfAngleRange, NonNegativeRange, PositiveRange, Section, Share, _in_order


class PatternShares(Section):
    """How often a scene is scanned with each pattern."""

    conical: float = Field(0.35, ge=0, description="circles (Palmer scanner), as Leica's sensors")
    parallel: float = Field(0.45, ge=0, description="parallel lines of a rotating polygon")
    cross_fire: float = Field(
        0.2, ge=0, description="two crossed channels of parallel lines, as RIEGL VQ-1560"
    )
    oscillating: float = Field(0, ge=0, description="zigzag of an oscillating mirror")

    @model_validator(mode="after")
    def _not_all_zero(self) -> Self:
        if self.conical + self.parallel + self.cross_fire + self.oscillating <= 0:
            raise ValueError("one share at least must be above 0")
        return self


class Clutter(Section):
    """What stands on, at or over buildings and is in no label; hd only."""

    dormer_share: Share = Field(0.1, description="buildings with dormers, one to three, if they fit")
    chimney_share: Share = Field(0.4, description="buildings with a chimney")
    raised_part_share: Share = Field(0.03, description="buildings with a part that rises above the roof")
    parapet_share: Share = Field(0.5, description="flat-roofed buildings with a parapet")
    skylight_share: Share = Field(0.15, description="buildings with a pane that mirrors pulses away")
    skylight_loss: Annotated[tuple[Share, Share], AfterValidator(_in_order)] = Field(
        (0.5, 1), description="share of pulses that such a pane loses"
    )
    annex_share: Share = Field(
        0.15, description="buildings with a garage or shed that their footprint leaves out"
    )
    trees_per_building: float = Field(0.4, ge=0, le=3, description="beside walls and over roofs, on average")
    shade_share: Share = Field(0.03, description="buildings that lack the data of a wedge")
    lower_part_share: Share = Field(
        0.05, description="buildings with a low flat part inside their footprint, as a garage, if it fits"
    )
    eave_overhang_share: Share = Field(
        0.5, description="buildings whose footprint is that of the eaves: their walls stand back"
    )
    eave_overhang_m: NonNegativeRange = Field((0.1, 0.7), description="how far such walls stand back")


class Scans(Section):
    """Simulated LiDAR survey; a pair of values bounds what is drawn per scene."""

    seed: int = Field(0, ge=0, description="of the survey and its noise")
    preset: Literal["none", "paper", "hd"] = Field(
        "hd",
        description="hd: mixed sensors as in LiDAR HD; paper: the paper's simulator, "
        "which ignores all below but density_per_m2; none: flown as hd, without any error",
    )
    density_per_m2: float | None = Field(
        8,
        ge=0.5,
        le=200,
        description="pulses per m2 over a scene (hd: the median); null: 14 for hd, 8 for paper and none",
    )
    density_spread: float = Field(
        0.35, ge=0, le=1, description="hd: sigma of the log-normal density of a scene"
    )
    density_bounds_per_m2: PositiveRange = Field((5, 30), description="hd: limits of that density")
    pattern_shares: PatternShares = PatternShares()
    altitude_m: PositiveRange = Field((900, 2000), description="of the flight above the median ground")
    conical_half_angle_deg: HalfAngleRange = Field((18, 22), description="off nadir, conical pattern")
    line_half_angle_deg: HalfAngleRange = Field((20, 30), description="off nadir, other patterns")
    speed_m_per_s: PositiveRange = Field((55, 80), description="of the flight")
    scan_rate_hz: PositiveRange = Field((100, 250), description="turns, lines or swings of the mirror")
    overlap: Annotated[
        tuple[Annotated[float, Field(ge=0, le=0.9)], Annotated[float, Field(ge=0, le=0.9)]],
        AfterValidator(_in_order),
    ] = Field((0.15, 0.55), description="of neighbouring strips, share of the swath")
    cross_strip_share: Share = Field(0.1, description="scenes with one more strip across")
    drift_m: float = Field(
        0.3, ge=0, le=10, description="standard deviation of the aircraft's drift, per axis"
    )
    attitude_deg: NonNegativeRange = Field((0.3, 1), description="largest roll, pitch and yaw")
    divergence_mrad: NonNegativeRange = Field((0.18, 0.3), description="beam, full 1/e2 angle")
    range_noise_m: NonNegativeRange = Field((0.005, 0.02), description="standard deviation along the ray")
    pointing_noise_m: NonNegativeRange = Field((0.01, 0.04), description="standard deviation in x and in y")
    strip_offset_xy_m: float = Field(
        0.05, ge=0, le=5, description="standard deviation of a strip's shift, per axis"
    )
    strip_offset_z_m: float = Field(0.02, ge=0, le=5, description="standard deviation of a strip's shift")
    base_loss: NonNegativeRange = Field((0.005, 0.01), description="share of pulses lost on any surface")
    dark_roof_share: Share = Field(0.02, description="roofs, dark or wet, that lose pulses")
    dark_roof_loss: NonNegativeRange = Field((0.3, 0.9), description="share of pulses such a roof loses")
    min_intensity: float = Field(
        0.03,
        ge=0,
        le=1,
        description="weakest echo: reflectance x cosine of incidence, at the planned altitude",
    )
    speckle: float = Field(0.3, ge=0, le=1, description="relative standard deviation of an echo's strength")
    clutter: Clutter = Clutter()
    max_returns: int = Field(1, ge=1, le=7, description="hd: echoes that a pulse may have")
    return_separation_m: float = Field(
        0.8, gt=0, le=10, description="of two echoes of a pulse, along the ray"
    )
    keep_margin_m: float = Field(
        5, ge=0, le=100, description="points are kept this far around the tile and its buildings"
    )

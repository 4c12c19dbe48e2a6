"""Section scans: the simulated LiDAR survey, its errors and the clutter in it."""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from p2wss.config.base import (
    HalfAngleRange,
    NonNegativeRange,
    PositiveRange,
    Section,
    Share,
    Shares,
    _in_order,
)


class PatternShares(Shares):
    """Relative frequency of each scan pattern among the scenes."""

    conical: float = Field(
        0.35, ge=0, description="circular pattern of a Palmer scanner, as in Leica's sensors"
    )
    parallel: float = Field(0.45, ge=0, description="parallel lines from a rotating polygon mirror")
    cross_fire: float = Field(
        0.2, ge=0, description="two crossed channels of parallel lines, as in the RIEGL VQ-1560"
    )


class Clutter(Section):
    """Clutter: objects on, beside and above buildings that are not part of the labels; preset hd only."""

    dormer_share: Share = Field(0.1, description="share of buildings with one to three dormers, if they fit")
    chimney_share: Share = Field(0.4, description="share of buildings with a chimney")
    annex_share: Share = Field(
        0.15,
        description="share of buildings with a garage or shed that is missing from the footprint, if it fits",
    )
    trees_per_building: float = Field(
        0.4,
        ge=0,
        le=3,
        description="mean number of trees per building, beside walls and above roofs; those with the trunk on a "
        "footprint are left out, in a town half of them",
    )
    eave_overhang_share: Share = Field(
        0.5, description="share of buildings whose footprint follows the eaves, with walls set back from it"
    )
    eave_overhang_m: NonNegativeRange = Field(
        (0.1, 0.7), description="range of the distance by which such walls are set back"
    )


class Scans(Section):
    """Stage scans: the simulated LiDAR survey. A pair of values is the range of a random draw per scene."""

    seed: int = Field(0, ge=0, description="seed of the survey and its noise")
    preset: Literal["none", "paper", "hd"] = Field(
        "hd",
        description="hd: various sensors as in LiDAR HD; paper: the simulator of the paper, which uses only "
        "density_per_m2 "
        "of the settings below; none: as hd, but without errors",
    )
    density_per_m2: float | None = Field(
        8,
        ge=0.5,
        le=200,
        description="pulses per m2 (hd: median over scenes); null = 14 for hd, 8 for paper and none",
    )
    density_spread: float = Field(
        0.35, ge=0, le=1, description="hd: sigma of the log-normal distribution of the density over scenes"
    )
    density_bounds_per_m2: PositiveRange = Field((5, 30), description="hd: limits of the density of a scene")
    pattern_shares: PatternShares = PatternShares()
    altitude_m: PositiveRange = Field((900, 2000), description="flight altitude above the median ground")
    conical_half_angle_deg: HalfAngleRange = Field(
        (18, 22), description="scan angle off nadir, conical pattern"
    )
    line_half_angle_deg: HalfAngleRange = Field(
        (20, 30), description="maximum scan angle off nadir, other patterns"
    )
    speed_m_per_s: PositiveRange = Field((55, 80), description="speed of the aircraft")
    scan_rate_hz: PositiveRange = Field(
        (100, 250), description="revolutions, lines or oscillations of the mirror per second"
    )
    overlap: Annotated[
        tuple[Annotated[float, Field(ge=0, le=0.9)], Annotated[float, Field(ge=0, le=0.9)]],
        AfterValidator(_in_order),
    ] = Field((0.15, 0.55), description="overlap of neighbouring strips, as a share of the swath")
    cross_strip_share: Share = Field(
        0.1, description="share of scenes with an additional strip perpendicular to the others"
    )
    drift_m: float = Field(
        0.3,
        ge=0,
        le=10,
        description="standard deviation of the distance of the aircraft from its flight line, per axis",
    )
    attitude_deg: NonNegativeRange = Field(
        (0.3, 1), description="maximum roll, pitch and yaw of the aircraft"
    )
    divergence_mrad: NonNegativeRange = Field((0.18, 0.3), description="beam divergence, full angle at 1/e2")
    range_noise_m: NonNegativeRange = Field(
        (0.005, 0.02), description="standard deviation of the noise along the beam"
    )
    pointing_noise_m: NonNegativeRange = Field(
        (0.01, 0.04), description="standard deviation of the noise in x and in y"
    )
    strip_offset_xy_m: float = Field(
        0.05, ge=0, le=5, description="standard deviation of the horizontal offset of a strip, per axis"
    )
    strip_offset_z_m: float = Field(
        0.02, ge=0, le=5, description="standard deviation of the vertical offset of a strip"
    )
    base_loss: NonNegativeRange = Field(
        (0.005, 0.01), description="share of pulses without a return on any surface"
    )
    dark_roof_share: Share = Field(
        0.02, description="share of roofs that are dark or wet and return fewer pulses"
    )
    dark_roof_loss: NonNegativeRange = Field(
        (0.3, 0.9), description="share of pulses without a return on such a roof"
    )
    min_intensity: float = Field(
        0.03,
        ge=0,
        le=1,
        description="detection threshold of a return: reflectance times cosine of incidence, at the planned "
        "altitude",
    )
    speckle: float = Field(
        0.3, ge=0, le=1, description="relative standard deviation of the intensity of a return"
    )
    clutter: Clutter = Clutter()
    keep_margin_m: float = Field(
        5, ge=0, le=100, description="margin around the tile and its buildings within which points are kept"
    )

    @model_validator(mode="after")
    def _density_within_bounds(self) -> Self:
        low, high = self.density_bounds_per_m2
        if self.preset == "hd" and not low <= (self.density_per_m2 or low) <= high:
            raise ValueError(
                "density_per_m2 must be within density_bounds_per_m2, to which it would be changed"
            )
        return self

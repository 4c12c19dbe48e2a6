"""Every setting of the pipeline: its type, bounds, default (the miniature's) and one line that explains it.

``config/default.yaml`` and ``config/schema.json`` are generated from here by ``make config``. Imports
nothing heavy: the Snakefile reads this module at each start.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from p2wss.errors import InputError

Share = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


# --- region -----------------------------------------------------------------------------------------------


class Region(Section):
    """Where: a place, cut into tiles."""

    name: str = Field("mini", pattern=r"^[A-Za-z0-9_-]+$", description="names the folder results/<name>")
    vintage: str = Field(
        "mini", pattern=r"^[A-Za-z0-9_.-]+$", description="edition of the data; names resources/ign/<vintage>"
    )
    crs: str = Field(
        "EPSG:2154", description="projected, metric; footprints, terrain and LiDAR must all be in it"
    )
    bounds_m: tuple[float, float, float, float] = Field(
        (652000, 6860000, 654000, 6862000), description="x_min, y_min, x_max, y_max in the CRS"
    )
    tile_size_m: float = Field(1000, gt=0, le=10000, description="edge of a scene")
    tiles: list[str] = Field(
        ["0652_6862", "0653_6862", "0652_6861"],
        description="tiles to make; [] = every tile of the bounds that has buildings (found by index_scenes)",
    )
    lidar_tiles: list[str] = Field(
        ["0653_6861"], description="tiles whose real (or stand-in) LiDAR is cropped; [] = none"
    )

    @model_validator(mode="after")
    def _bounds_in_order(self) -> Self:
        x_min, y_min, x_max, y_max = self.bounds_m
        if x_min >= x_max or y_min >= y_max:
            raise ValueError("bounds_m must be x_min, y_min, x_max, y_max")
        return self


# --- fetch ------------------------------------------------------------------------------------------------


class Folder(Section):
    """Files that are already on disk."""

    footprints: str = Field(
        "tests/mini/bdtopo/BDTOPO_mini.gpkg",
        description="BD TOPO as GeoPackage, shapefile or GeoParquet, or a folder or pattern of such files",
    )
    footprints_layer: str = Field("batiment", description="layer, where a file has several")
    dtm: str = Field(
        "tests/mini/rgealti",
        description="RGE ALTI .asc, as delivered in .7z, .7z.001, .., or GeoTIFF: file, folder or pattern",
    )
    lidar: str = Field("tests/mini/lidar", description="LAS, LAZ or COPC: a file, a folder or a pattern")
    lidar_crs: str = Field(
        "",
        description="CRS of those clouds where it is not region.crs: PDAL reprojects them; '' = region.crs",
    )


class Geoplateforme(Section):
    """IGN's services; names and limits as of 2026."""

    wfs_url: str = Field("https://data.geopf.fr/wfs/ows", description="vector service (WFS 2.0)")
    wms_url: str = Field("https://data.geopf.fr/wms-r", description="raster service (WMS 1.3)")
    footprints_type: str = Field("BDTOPO_V3:batiment", description="WFS type of the footprints")
    footprints_id: str = Field(
        "cleabs", description="attribute that pages are sorted by and repeats are found by"
    )
    page_size: int = Field(1000, ge=1, le=5000, description="features per request; the service cuts at 5000")
    footprints_window_m: float = Field(
        0, ge=0, description="footprints are asked for by squares of this edge; 0 = the whole region at once"
    )
    dtm_layer: str = Field(
        "ELEVATION.ELEVATIONGRIDCOVERAGE.HIGHRES",
        description="WMS layer; LiDAR HD has IGNF_LIDAR-HD_MNT_ELEVATION.ELEVATIONGRIDCOVERAGE.LAMB93",
    )
    dtm_format: Literal["image/geotiff", "image/x-bil;bits=32"] = Field(
        "image/geotiff", description="both carry heights as float32"
    )
    dtm_resolution_m: float = Field(
        1.0, gt=0, description="cells centred on multiples of it; 0.5 for LiDAR HD"
    )
    dtm_max_pixels: int = Field(
        4000, ge=1, le=10000, description="per side of one request; the service allows 10000"
    )
    dtm_nodata_below_m: float = Field(
        -9998, description="heights below are no data: -9999 in LiDAR HD, -99999 in RGE ALTI"
    )
    lidar_types: list[str] = Field(
        ["IGNF_LIDAR-HD_METADONNEE:metadata", "IGNF_NUAGES-DE-POINTS-LIDAR-HD:dalle"],
        description="WFS types that list the LiDAR tiles, tried in turn",
    )
    lidar_url_fields: list[str] = Field(
        ["url_npl", "url"], description="attributes that may hold the address of the point cloud"
    )
    lidar_window_share: Share = Field(
        0.3,
        description="where less than this share of a COPC tile is needed, only that window is read; 0 = never",
    )
    requests_per_s: float = Field(1.0, gt=0, description="at most; the services allow more, but not always")
    timeout_s: float = Field(60, gt=0, description="without an answer, per request")
    max_attempts: int = Field(6, ge=1, description="of one request, while the service is busy or fails")
    max_wait_s: float = Field(600, gt=0, description="for one request with all its attempts")
    user_agent: str = Field("p2wss", description="how requests introduce themselves")


class Prepare(Section):
    """Real clouds before use: the tile and its margin, ground where none is classified, by PDAL."""

    mode: Literal["never", "auto", "pdal"] = Field(
        "auto", description="use of PDAL: never, for clouds without ground points (class 2), or for all"
    )
    pdal_command: str = Field(
        "pdal", description="PDAL and its options ({folder} = where it finds its files, for containers)"
    )
    pdal_stages: str = Field(
        "config/pdal/prepare.json",
        description="PDAL's filters, in order; tags if_no_ground_.. run only where class 2 is absent",
    )
    pdal_timeout_s: float = Field(7200, gt=0, description="for one tile")


class Fetch(Section):
    """Get footprints, terrain and LiDAR."""

    source: Literal["folder", "geoplateforme"] = Field(
        "folder", description="files on disk, or IGN's services"
    )
    offline: bool = Field(
        False,
        description="send no request: use what is in resources/ign/<vintage>/downloads, name what is not",
    )
    sources: str = Field(
        "config/sources.csv",
        description="table of products, licences and attributions, for the report's footer",
    )
    margin_m: float = Field(
        100,
        ge=0,
        description="footprints beyond the region, terrain and LiDAR beyond a tile; scenes.margin_m + 30 or more",
    )
    prepare: Prepare = Prepare()
    folder: Folder = Folder()
    geoplateforme: Geoplateforme = Geoplateforme()


# --- scenes -----------------------------------------------------------------------------------------------


class RoofShares(Section):
    """How often each roof type is drawn; what cannot be built on a footprint becomes the nearest that can."""

    gable: float = Field(0.44, ge=0, description="two slopes, vertical gables; wings get gables of their own")
    hip: float = Field(0.18, ge=0, description="slopes on all sides")
    half_hip: float = Field(0.1, ge=0, description="one end hipped, the other a gable")
    shed: float = Field(0.06, ge=0, description="one slope")
    flat: float = Field(0.14, ge=0, description="no slope")
    mixed: float = Field(0.08, ge=0, description="each edge on its own")

    @model_validator(mode="after")
    def _not_all_zero(self) -> Self:
        if not sum(self.model_dump().values()) > 0:
            raise ValueError("at least one share must be above 0")
        return self


class Scenes(Section):
    """Cut tiles, clean footprints, draw heights and roof angles."""

    seed: int = Field(0, ge=0, description="of heights and angles")
    margin_m: float = Field(
        60, ge=0, description="buildings this near to a tile stand in its scene, as occluders"
    )
    simplify_tolerance_m: float = Field(
        0.2,
        ge=0,
        le=5,
        description="outlines may move by this much to lose vertices (Douglas-Peucker); 0 = never",
    )
    min_edge_m: float = Field(0.1, ge=0.01, le=5, description="shorter edges are taken out")
    min_area_m2: float = Field(2, gt=0, description="smaller footprints and courtyards are left out")
    max_edges: int = Field(1000, ge=3, le=5000, description="footprints with more edges are left out")
    min_eave_height_m: float = Field(1.5, gt=0, description="a lower height counts as unknown")
    max_eave_height_m: float = Field(99, gt=0, description="higher buildings are left out")
    storey_height_m: float = Field(
        3, gt=0, description="of a building whose number of floors is all that is known"
    )
    min_terrain_share: Share = Field(
        0.5, description="of a footprint's outline that must lie on known terrain, else it is left out"
    )
    sampler: Literal["realistic", "uniform"] = Field(
        "realistic",
        description="angles by roof type, or (the paper's words) each edge from 0, 90, 20..45 alike",
    )
    roof_shares: RoofShares = RoofShares()
    max_rise_m: float = Field(
        7,
        gt=0,
        description="the realistic sampler draws flatter roofs for buildings whose roof would rise more",
    )
    max_failed_fraction: Share = Field(
        0.1, description="share of rejected buildings past which the job fails; too small ones do not count"
    )


# --- buildings --------------------------------------------------------------------------------------------


class Buildings(Section):
    """Parametric buildings by weighted straight skeleton."""

    max_roof_height_m: float = Field(12, gt=0, description="a roof that would rise further is cut flat")
    max_failed_fraction: Share = Field(
        0.02, description="share of rejected buildings past which the job fails"
    )


# --- scans ------------------------------------------------------------------------------------------------


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


def _in_order(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] > bounds[1]:
        raise ValueError("must be lower bound, upper bound")
    return bounds


NonNegativeRange = Annotated[
    tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)]], AfterValidator(_in_order)
]
PositiveRange = Annotated[
    tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]], AfterValidator(_in_order)
]
HalfAngleRange = Annotated[
    tuple[Annotated[float, Field(ge=1, le=45)], Annotated[float, Field(ge=1, le=45)]],
    AfterValidator(_in_order),
]


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


# --- crops ------------------------------------------------------------------------------------------------


class Crops(Section):
    """Points of each building, in shards, with splits."""

    seed: int = Field(0, ge=0, description="of the split")
    buffer_m: float = Field(
        1, gt=0, le=20, description="points within this distance of the footprint are kept"
    )
    min_points: int = Field(20, ge=1, description="buildings with fewer points are left out")
    max_points: int = Field(
        2048, ge=1, description="buildings with more points are marked as truncated; all points are kept"
    )
    split: Literal["blocks", "train", "val", "test"] = Field(
        "blocks", description="blocks: by place, see below; else every building of the region is in this one"
    )
    block_size_m: float = Field(
        125, gt=0, description="edge of the square blocks that go to train, val or test as a whole"
    )
    guard_m: float = Field(
        10, ge=0, description="val and test buildings nearer than this to another split are set aside"
    )


# --- dvae -------------------------------------------------------------------------------------------------


class Optimiser(Section):
    """AdamW, cosine warm-up, then cosine decay, per step."""

    num_steps: int = Field(200, ge=1, description="batches to train on")
    batch_size: int = Field(64, ge=2, description="buildings per step")
    learning_rate: float = Field(2e-3, gt=0, description="highest")
    learning_rate_end: float = Field(1e-6, ge=0, description="at the last step")
    warmup_share: Share = Field(0.05, description="of the steps, with the rate rising")
    weight_decay: float = Field(
        5e-4, ge=0, description="not on biases, norms, embeddings, codebooks and tokens"
    )
    beta2: float = Field(0.98, gt=0, lt=1, description="of AdamW")
    gradient_clip: float = Field(1.0, gt=0, description="largest norm of the gradient")


class Compute(Section):
    """Where and how it is trained; what is learnt depends on it by rounding only."""

    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="auto: a GPU where there is one")
    precision: Literal["float32", "bfloat16"] = Field(
        "float32", description="of matrix products (autocast); weights and losses stay float32"
    )
    compile: bool = Field(
        False, description="compile the networks first (torch.compile): long trainings only"
    )
    resident: bool = Field(False, description="keep the clouds in the memory of the device")
    tensorboard: bool = Field(False, description="metrics for TensorBoard too, beside the checkpoints")


class Dvae(Section):
    """Discrete VAE that turns patches of points into tokens."""

    seed: int = Field(0, ge=0, description="of weights, batches and augmentation")
    num_points: int = Field(
        768, ge=64, description="points of a cloud that are used; larger ones are thinned"
    )
    min_points: int = Field(64, ge=1, description="smaller clouds are left out of training")
    num_patches: int = Field(32, ge=4, description="patches per cloud (farthest point sampling)")
    patch_size: int = Field(16, ge=4, multiple_of=4, description="points per patch (nearest neighbours)")
    patch_dim: int = Field(32, ge=8, multiple_of=8, description="width of a patch embedding")
    token_dim: int = Field(32, ge=8, multiple_of=8, description="width of a code and of the DGCNN")
    num_tokens: int = Field(128, ge=8, multiple_of=4, description="size of the codebook")
    temperature_end: float = Field(
        0.0625, gt=0, le=1, description="of the Gumbel softmax, from 1, at half-time"
    )
    kl_weight: float = Field(0.1, ge=0, description="of the divergence from uniform codes, reached at 55 %")
    use_lidar: bool = Field(True, description="train on real LiDAR too: this stage needs no labels")
    optimiser: Optimiser = Optimiser()
    checkpoint_every_steps: int = Field(100, ge=1, description="also: how often validation runs")
    num_validation: int = Field(128, ge=1, description="clouds of the val split to measure while training")
    compute: Compute = Compute()


# --- model ------------------------------------------------------------------------------------------------


class Masking(Section):
    """What the model must restore while it trains. The paper: 0, 0 and [0.3, 0.3]."""

    inference_share: Share = Field(0.8, description="samples that hide all digits of height and angles")
    table1_share: Share = Field(0.1, description="samples that hide all digits; the rest hide random tokens")
    random_ratio: tuple[Share, Share] = Field((0.15, 1.0), description="share of tokens hidden at random")
    patch_ratio: tuple[Share, Share] = Field((0.25, 0.45), description="share of patches hidden, in a block")


class Augmentation(Section):
    """Random changes of a building each time it is seen, besides the paper's rotation."""

    mirror: bool = Field(True, description="mirror half of the samples")
    scale: tuple[float, float] = Field(
        (0.8, 1.25), description="[1, 1] = off; scales the building as a whole"
    )
    lift_m: float = Field(2.0, ge=0, description="raise or lower what stands above the ground by up to this")
    jitter_m: float = Field(0.02, ge=0, description="noise on the points, standard deviation")
    keep_points: tuple[Share, Share] = Field((0.4, 1.0), description="share of the points kept; [1, 1] = off")
    occlusion_share: Share = Field(0.1, description="samples that lack the points of a wedge")


class LossWeights(Section):
    """Weights of the four losses in the total. The paper: 1, 1, 1, 1."""

    cloud: float = Field(0.3, ge=0, description="restoring masked patches")
    sequence: float = Field(1.0, ge=0, description="restoring masked parameter tokens")
    modal: float = Field(0.1, ge=0, description="alignment of the encoders")
    match: float = Field(0.1, ge=0, description="matching of pairs after the cross-modality encoders")


class Decoding(Section):
    """From probabilities of digits to values. The paper: argmax, all, 1."""

    mode: Literal["argmax", "median"] = Field("median", description="per digit, or of the joint distribution")
    angle_support: Literal["roofs", "all"] = Field(
        "roofs", description="angles that may be answered: 0, 90 and 20 to 45, or 0 to 90"
    )
    num_rotations: int = Field(4, ge=1, le=64, description="views whose probabilities are averaged")


class ModelOptimiser(Optimiser):
    """AdamW, cosine warm-up, then cosine decay, per step."""

    num_steps: int = Field(800, ge=1, description="batches to train on")
    batch_size: int = Field(32, ge=2, description="buildings per step")


class Model(Section):
    """Point2WSS, the multimodal transformer. Points and patches are those of the dvae."""

    weights: str = Field("", description="trained weights to use instead of training; '' = train")
    seed: int = Field(0, ge=0, description="of weights, batches and augmentation")
    max_vertices: int = Field(16, ge=3, le=128, description="buildings with more are left out of training")
    coord_decimals: Literal[1, 2] = Field(1, description="of coordinates in tokens; the paper's 2 is slower")
    hundreds: bool = Field(False, description="digits up to 999 m; without, heights and coordinates < 100 m")
    dim: int = Field(64, ge=8, multiple_of=8, description="width")
    num_heads: int = Field(4, ge=1, description="of attention; divides the width")
    mlp_ratio: float = Field(4.0, gt=0, description="hidden width of the MLPs over the width")
    drop_path: Share = Field(0.0, description="stochastic depth, at the last block")
    cloud_depth: int = Field(2, ge=1, description="blocks of the point cloud encoder")
    sequence_depth: int = Field(1, ge=1, description="blocks of the parameter encoder")
    cross_depth: int = Field(2, ge=1, description="blocks of each cross-modality encoder")
    align_dim: int = Field(64, ge=1, description="width of the space in which both modalities are aligned")
    auxiliary_share: float = Field(
        0.25,
        gt=0,
        le=1,
        description="share of a batch that also restores patches, is aligned and matched; the paper: 1",
    )
    match_balanced: bool = Field(
        True, description="matching loss halved between pairs and non-pairs, or 0.1/0.9"
    )
    ground_relative: bool = Field(True, description="patches also know their height above the ground")
    numerical_encoding: bool = Field(
        True, description="digits also carry their value (Regression Transformer)"
    )
    edge_embedding: bool = Field(
        True, description="tokens also carry the geometry of their edge where visible"
    )
    edge_attention: bool = Field(
        True, description="tokens also gather from the patches what lies where, seen from their edge"
    )
    ema_decay: float = Field(0.99, ge=0, lt=1, description="of the averaged weights that are kept; 0 = off")
    loss_weights: LossWeights = LossWeights()
    masking: Masking = Masking()
    augmentation: Augmentation = Augmentation()
    decoding: Decoding = Decoding()
    optimiser: ModelOptimiser = ModelOptimiser()
    checkpoint_every_steps: int = Field(200, ge=1, description="also: how often validation runs")
    num_validation: int = Field(128, ge=1, description="buildings of the val split to measure while training")
    compute: Compute = Compute()

    @model_validator(mode="after")
    def _heads_divide(self) -> Self:
        if self.dim % self.num_heads:
            raise ValueError("num_heads must divide dim")
        return self


# --- ablation ---------------------------------------------------------------------------------------------

_PAPER_MASKING = {"masking": {"inference_share": 0, "table1_share": 0, "random_ratio": [0.3, 0.3]}}
_PAPER_DECODING = {"decoding": {"mode": "argmax", "angle_support": "all", "num_rotations": 1}}
_NO_AUGMENTATION = {
    "augmentation": {
        "mirror": False,
        "scale": [1, 1],
        "lift_m": 0,
        "jitter_m": 0,
        "keep_points": [1, 1],
        "occlusion_share": 0,
    }
}
_NO_EDGES = {"edge_embedding": False, "edge_attention": False}
_PAPER_LOSSES = {
    "auxiliary_share": 1,
    "match_balanced": False,
    "loss_weights": {"cloud": 1, "sequence": 1, "modal": 1, "match": 1},
}
_PLAIN_INPUT = {"ground_relative": False, "numerical_encoding": False}
_PAPER = {
    **_PAPER_MASKING,
    **_PAPER_DECODING,
    **_NO_AUGMENTATION,
    **_NO_EDGES,
    **_PAPER_LOSSES,
    **_PLAIN_INPUT,
    "ema_decay": 0,
}


class Ablation(Section):
    """Models trained with single switches changed (target ablation)."""

    variants: dict[Annotated[str, Field(pattern=r"^[a-z0-9_]+$")], dict[str, Any]] = Field(
        {
            "plus": {},
            "plus_seed_1": {"seed": 1},
            "plus_seed_2": {"seed": 2},
            "paper": _PAPER,
            "masking_of_paper": _PAPER_MASKING,
            "decoding_of_paper": _PAPER_DECODING,
            "one_view": {"decoding": {"num_rotations": 1}},
            "losses_of_paper": _PAPER_LOSSES,
            "no_augmentation": _NO_AUGMENTATION,
            "no_mirror": {"augmentation": {"mirror": False}},
            "no_occlusion": {"augmentation": {"occlusion_share": 0}},
            "all_auxiliary": {"auxiliary_share": 1},
            "no_average": {"ema_decay": 0},
            "no_ground": {"ground_relative": False},
            "no_numerical_encoding": {"numerical_encoding": False},
            "no_edge_attention": {"edge_attention": False},
            "no_edges": _NO_EDGES,
        },
        min_length=1,
        description="name: changes of the section model, one training each",
    )


# --- eval -------------------------------------------------------------------------------------------------


class Eval(Section):
    """Tables 1 and 2 of the paper, and the report."""

    seed: int = Field(0, ge=0, description="of the points sampled on meshes")
    baselines: list[Literal["lod1", "constant", "roofer"]] = Field(
        ["lod1", "constant", "roofer"], description="methods beside ours; roofer only where it is installed"
    )
    lidar_name: str = Field(
        "stand-in LiDAR", min_length=1, description="what the report calls the clouds of region.lidar_tiles"
    )
    attribution: list[str] = Field(
        [], description="lines of the report's footer beside those of fetch.sources"
    )
    num_samples: int = Field(2048, gt=0, description="points sampled on each mesh for the Chamfer distance")
    max_num_points: int = Field(2048, gt=0, description="points of a cloud used for it: a subset by the seed")
    num_resamples: int = Field(1000, ge=10, description="bootstrap draws behind each 95 % interval")
    num_worst: int = Field(
        20, ge=0, le=100, description="buildings shown per data set, worst first, with the reason"
    )
    num_pictures: int = Field(
        2, ge=0, le=20, description="buildings shown for each counterpart of the paper's Figures 7 to 14"
    )
    roofer_command: str = Field(
        "roofer",
        description="Roofer and its options ({folder} = folder of its input and output, for containers); '' = never",
    )
    roofer_recorded: str = Field(
        "",
        description="what an earlier Roofer made of this LiDAR (CityJSON, folder), where none is installed; '' = none",
    )
    roofer_timeout_s: float = Field(3600, gt=0, description="for one run of Roofer, one tile")


# --- reconstruct ------------------------------------------------------------------------------------------


# what `p2wss reconstruct` writes, and how the names of these files end
OUTPUT_SUFFIXES = {
    "cityjsonseq": ".city.jsonl",
    "cityjson": ".city.json",
    "glb": ".glb",
    "obj": ".obj",
    "ply": ".ply",
    "stl": ".stl",
    "gpkg": ".gpkg",
    "geoparquet": ".parquet",
}
Output = Literal["cityjsonseq", "cityjson", "glb", "obj", "ply", "stl", "gpkg", "geoparquet"]


class Reconstruct(Section):
    """Buildings from the user's own LiDAR."""

    outputs: list[Output] = Field(
        ["cityjsonseq", "glb", "gpkg"], min_length=1, description="files to write, beside a summary in JSON"
    )
    per_building: bool = Field(
        False, description="one more glb, obj, ply and stl for each building, as far as outputs has them"
    )
    buffer_m: float = Field(
        1, ge=0, le=20, description="points within this distance of a footprint are its cloud"
    )
    min_num_points: int = Field(
        10, ge=1, description="a building with fewer gets a flat roof, none without any"
    )
    simplify_m: float = Field(
        0.3, ge=0, le=5, description="Douglas-Peucker tolerance for real footprints; 0 = as they are"
    )
    min_eave_height_m: float = Field(1, gt=0, description="lower predictions are raised to this")
    max_roof_height_m: float = Field(12, gt=0, description="a roof that would rise further is cut flat")
    refine: bool = Field(True, description="fit height, angles and classes to the points after the network")
    max_parts: int = Field(
        4, ge=1, le=16, description="heights of one building at most; 1 = the paper's model"
    )
    dormers: bool = Field(
        False, description="box dormers and small boxes that rise out of a fitted roof, up to four each"
    )
    not_representable_m: float = Field(
        0.25, gt=0, description="a fitted building whose points are further off in the mean is flagged"
    )
    terrain_tolerance_m: float = Field(
        0.2, gt=0, le=10, description="of the triangulated terrain, where --terrain gives one"
    )
    terrain_margin_m: float = Field(20, ge=0, le=1000, description="of that terrain around the buildings")


# --- the whole --------------------------------------------------------------------------------------------


class Config(Section):
    """All sections, in the order of the pipeline."""

    region: Region = Region()
    fetch: Fetch = Fetch()
    scenes: Scenes = Scenes()
    buildings: Buildings = Buildings()
    scans: Scans = Scans()
    crops: Crops = Crops()
    dvae: Dvae = Dvae()
    model: Model = Model()
    ablation: Ablation = Ablation()
    eval: Eval = Eval()
    reconstruct: Reconstruct = Reconstruct()

    @model_validator(mode="after")
    def _variants_are_models(self) -> Self:
        for name in self.ablation.variants:
            try:
                ablated(self, name)
            except ValidationError as error:
                first = error.errors()[0]
                key = ".".join(["ablation.variants", name, *map(str, first["loc"])])
                raise ValueError(f"{key}: {first['msg']}") from None
        return self

    @model_validator(mode="after")
    def _terrain_under_margins(self) -> Self:
        # a command gets only the sections of its stage; the others then stand at their defaults
        together = {"fetch", "scenes"} <= self.model_fields_set
        if together and self.fetch.margin_m < self.scenes.margin_m + 30:
            raise ValueError("fetch.margin_m must be at least scenes.margin_m + 30")
        return self


def load(*documents: str | Path | dict[str, Any]) -> Config:
    """The config of the given YAML files or mappings, later ones over earlier ones, over the defaults.

    A string that starts with ``{`` is JSON. Raises :class:`InputError` that names the key and what is wrong.
    """
    merged: dict[str, Any] = {}
    for document in documents:
        sections = _parse(document).items()
        _merge(merged, {name: {} if section is None else section for name, section in sections})
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "config"
        reason = "no such key" if first["type"] == "extra_forbidden" else first["msg"]
        raise InputError(f"config: {key}: {reason}{_suggestion(first)}") from error


def ablated(config: Config, variant: str) -> Config:
    """The config with the changes that a variant of the ablation makes to the section model."""
    section = config.model.model_dump(mode="json")
    _merge(section, config.ablation.variants[variant])
    return config.model_copy(update={"model": Model.model_validate(section)})


def section_json(config: Config, *names: str, without: Collection[str] = ()) -> str:
    """The named sections as one line of JSON, which :func:`load` reads back; without some of their keys."""
    sections = {name: getattr(config, name).model_dump(mode="json", exclude=set(without)) for name in names}
    return json.dumps(sections, sort_keys=True)


def _parse(document: str | Path | dict[str, Any]) -> dict[str, Any]:
    if isinstance(document, dict):
        return document
    text = str(document)
    if not text.lstrip().startswith("{"):
        try:
            text = Path(document).read_text()
        except OSError as error:
            raise InputError(f"config: {document}: {error.strerror}") from error
    try:
        parsed = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        raise InputError(f"config: {document}: not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(parsed, dict):
        raise InputError(f"config: {document}: expected sections with keys, found {type(parsed).__name__}")
    return parsed


def _merge(into: dict[str, Any], other: dict[str, Any]) -> None:
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = json.loads(json.dumps(value)) if isinstance(value, dict) else value


def _suggestion(error: Any) -> str:
    if error["type"] != "extra_forbidden":
        return ""
    from difflib import get_close_matches

    model: Any = Config
    for part in error["loc"][:-1]:
        if isinstance(part, str) and part in getattr(model, "model_fields", {}):
            model = model.model_fields[part].annotation
    near = get_close_matches(str(error["loc"][-1]), getattr(model, "model_fields", {}), n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def default_yaml() -> str:
    """Every key with its default and its one-line description, as YAML."""
    lines = [
        "# Every setting, with the miniature's value. Generated from src/p2wss/config.py by `make config`.",
        "# yaml-language-server: $schema=schema.json",
    ]
    _emit(Config(), lines, "")
    return "\n".join(lines) + "\n"


def _emit(model: Section, lines: list[str], indent: str) -> None:
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        if isinstance(value, Section):
            about = field.description or (type(value).__doc__ or "").split("\n")[0]
            lines += ([""] if not indent else []) + [f"{indent}{name}:  # {about}"]
            _emit(value, lines, indent + "  ")
        else:
            plain = json.dumps(model.model_dump(mode="json")[name], ensure_ascii=False)
            lines.append(
                f"{indent}{name}: {plain}" + (f"  # {field.description}" if field.description else "")
            )


def main(folder: str = "config") -> None:
    """Write ``default.yaml`` and ``schema.json``."""
    Path(folder, "default.yaml").write_text(default_yaml())
    Path(folder, "schema.json").write_text(json.dumps(Config.model_json_schema(), indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Section fetch: footprints, terrain and LiDAR, and where they come from."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section, Share


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

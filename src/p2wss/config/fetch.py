"""Section fetch: the sources of footprints, terrain and LiDAR."""

from typing import Any, Literal

from pydantic import Field

from p2wss.config.base import Section
from p2wss.config.reconstruct import SchemaName

# the source of a place that a user names, unless the user names another one
IGN = {"fetch": {"source": "geoplateforme"}}


class Folder(Section):
    """Source folder: files on disk."""

    footprints: str = Field(
        "tests/mini/bdtopo/BDTOPO_mini.gpkg",
        description="BD TOPO as GeoPackage, shapefile or GeoParquet: a file, a folder or a pattern",
    )
    footprints_layer: str = Field("batiment", description="layer to read from a file that has several layers")
    footprints_schema: SchemaName = Field(
        "bdtopo",
        description="source of the footprints, which defines the columns of ids, heights and storeys; auto = "
        "recognise it from the columns",
    )
    dtm: str = Field(
        "tests/mini/rgealti",
        description="RGE ALTI as .asc or GeoTIFF: a file, a folder or a pattern",
    )
    lidar: str = Field(
        "tests/mini/lidar", description="LAS, LAZ or COPC files: a file, a folder or a pattern"
    )
    lidar_crs: str = Field(
        "",
        description="CRS of these clouds if it differs from region.crs, so that PDAL reprojects them; '' = "
        "region.crs",
    )


class Geoplateforme(Section):
    """Source geoplateforme: IGN's services, with their names and limits as of 2026."""

    wfs_url: str = Field("https://data.geopf.fr/wfs/ows", description="URL of the vector service (WFS 2.0)")
    wms_url: str = Field("https://data.geopf.fr/wms-r", description="URL of the raster service (WMS 1.3)")
    footprints_type: str = Field("BDTOPO_V3:batiment", description="WFS feature type of the footprints")
    footprints_id: str = Field(
        "cleabs", description="id attribute, used to sort the pages and to remove duplicate features"
    )
    page_size: int = Field(
        1000, ge=1, le=5000, description="number of features per request; the service allows 5000"
    )
    footprints_window_m: float = Field(
        0, ge=0, description="request footprints in square windows of this size; 0 = the whole region at once"
    )
    dtm_layer: str = Field(
        "ELEVATION.ELEVATIONGRIDCOVERAGE.HIGHRES",
        description="WMS layer; for LiDAR HD: IGNF_LIDAR-HD_MNT_ELEVATION.ELEVATIONGRIDCOVERAGE.LAMB93",
    )
    dtm_resolution_m: float = Field(
        1.0, gt=0, description="cell size of the terrain; cell centres are multiples of it; 0.5 for LiDAR HD"
    )
    dtm_max_pixels: int = Field(
        4000,
        ge=1,
        le=10000,
        description="largest number of pixels per side of a request; the service allows 10000",
    )
    dtm_nodata_below_m: float = Field(
        -9998, description="heights below this value mean no data: -9999 in LiDAR HD, -99999 in RGE ALTI"
    )
    lidar_types: list[str] = Field(
        ["IGNF_LIDAR-HD_METADONNEE:metadata", "IGNF_NUAGES-DE-POINTS-LIDAR-HD:dalle"],
        description="WFS feature types that list the LiDAR tiles, tried in order",
    )
    lidar_url_fields: list[str] = Field(
        ["url_npl", "url"], description="attributes that may hold the URL of a LiDAR tile, tried in order"
    )
    requests_per_s: float = Field(
        1.0, gt=0, description="maximum request rate; the services usually allow more"
    )
    timeout_s: float = Field(60, gt=0, description="time without a response after which a request fails")
    max_attempts: int = Field(
        6, ge=1, description="maximum number of attempts per request while the service is busy or fails"
    )
    max_wait_s: float = Field(
        600, gt=0, description="maximum total time of a request, including all attempts"
    )
    max_response_mb: float = Field(
        500,
        gt=0,
        description="maximum size of a response after decompression, except for LiDAR tiles",
    )
    max_download_mb: float = Field(
        20_000,
        gt=0,
        description="maximum size of a LiDAR tile to download; tiles of LiDAR HD have up to about 1,000 MB",
    )
    redirect_hosts: list[str] = Field(
        [],
        description="additional hosts to which a service may redirect; a redirect to any other host is "
        "rejected",
    )
    user_agent: str = Field("p2wss", description="User-Agent header of the requests")


class Prepare(Section):
    """Preparation of real clouds: crop to the tile and its margin, and classify ground points with PDAL."""

    mode: Literal["never", "auto", "pdal"] = Field(
        "auto",
        description="when to run PDAL: never; auto = on clouds without ground points (class 2); pdal = on "
        "all clouds",
    )
    pdal_command: str = Field(
        "pdal",
        description="command and options of PDAL ({folder} = the folder with its files, for containers)",
    )
    pdal_stages: str = Field(
        "config/pdal/prepare.json",
        description="PDAL filters in order; those tagged if_no_ground_.. run only on clouds without class 2",
    )
    pdal_timeout_s: float = Field(7200, gt=0, description="time limit of PDAL for one tile")


class Fetch(Section):
    """Stage fetch: get footprints, terrain and LiDAR."""

    source: Literal["folder", "geoplateforme"] = Field(
        "folder",
        description="where the data come from: folder = files on disk, geoplateforme = IGN's services",
    )
    margin_m: float = Field(
        100,
        ge=0,
        description="margin around the region (footprints) or tile (terrain, LiDAR); at least "
        "scenes.margin_m + 30",
    )
    prepare: Prepare = Prepare()
    folder: Folder = Folder()
    geoplateforme: Geoplateforme = Geoplateforme()

    @property
    def of_tiles(self) -> dict[str, Any]:
        """The settings on which the delivered terrain and clouds of a tile depend."""
        of_footprints = {name for name in Folder.model_fields if name.startswith("footprints")}
        if self.source == "folder":
            return {"margin_m": self.margin_m} | self.folder.model_dump(exclude=of_footprints)
        return {"margin_m": self.margin_m} | self.geoplateforme.model_dump()

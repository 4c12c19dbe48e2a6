"""Section reconstruct: reconstruction from the user's LiDAR."""

from typing import Literal

from pydantic import Field

from p2wss.config.base import Section, Share

# the output formats of `p2wss reconstruct` and the suffixes of their files
OUTPUT_SUFFIXES = {
    "cityjsonseq": ".city.jsonl",
    "cityjson": ".city.json",
    "glb": ".glb",
    "obj": ".obj",
    "ply": ".ply",
    "stl": ".stl",
    "sionna": "_sionna/scene.xml",
    "helios": "_helios/scene.xml",
    "gpkg": ".gpkg",
    "geoparquet": ".parquet",
    "report": ".html",
}
# suffix of the file of `reconstruct.wedges`
WEDGES_SUFFIX = ".wedges.parquet"
# suffix of the file of tracebacks of internal errors, written only if there are any
ERRORS_SUFFIX = ".errors.log"
Output = Literal[
    "cityjsonseq",
    "cityjson",
    "glb",
    "obj",
    "ply",
    "stl",
    "sionna",
    "helios",
    "gpkg",
    "geoparquet",
    "report",
]
# formats without meshes, and so without terrain
TABLES_AND_MODELS: tuple[Output, ...] = ("cityjsonseq", "cityjson", "gpkg", "geoparquet", "report")
# explained in p2wss.formats.materials
MaterialName = Literal[
    "concrete",
    "brick",
    "wood",
    "glass",
    "marble",
    "metal",
    "plasterboard",
    "chipboard",
    "plywood",
    "very_dry_ground",
    "medium_dry_ground",
    "wet_ground",
    "stone",
    "millstone",
    "slate",
    "concrete_block",
    "tile",
    "zinc",
]


class Materials(Section):
    """Materials in mesh files, for buildings whose footprints state none."""

    wall: MaterialName = Field("concrete", description="material of walls and floors")
    roof: MaterialName = Field("concrete", description="material of roofs")
    ground: MaterialName = Field(
        "medium_dry_ground",
        description="material of the terrain of --terrain and of open ground in footprints",
    )
    vegetation: MaterialName = Field("wood", description="material of the plants of --vegetation")
    from_footprints: bool = Field(
        True,
        description="use the materials stated in the BD TOPO columns materiaux_des_murs and "
        "materiaux_de_la_toiture",
    )


HeightUnit = Literal["", "m", "ft", "us-ft", "dm", "cm", "mm"]
SchemaName = Literal["auto", "bdtopo", "overture", "osm", "bag", "3dbag", "swissbuildings"]


class Outlines(Section):
    """Building outlines derived from the points alone, without footprints."""

    cell_m: float = Field(
        0.5,
        gt=0,
        le=5,
        description="size of the cells in which points are counted; increased if a cell would hold fewer "
        "than two points",
    )
    jump_m: float = Field(
        1.5,
        gt=0,
        description="a block is split into buildings where the heights of neighbouring cells differ by more "
        "than this and the slope around",
    )
    min_area_m2: float = Field(10, gt=0, description="blocks smaller than this are discarded")
    min_part_m2: float = Field(
        20,
        ge=0,
        description="parts between height discontinuities are merged with a neighbour if they are smaller than "
        "this",
    )
    max_area_m2: float = Field(
        150, gt=0, description="larger buildings are split again at half the height difference, down to 0.4 m"
    )
    min_hole_m2: float = Field(8, ge=0, description="courtyards smaller than this are filled")
    min_edge_m: float = Field(0.8, gt=0, description="edges shorter than this are removed from outlines")
    overhang_m: float = Field(
        0.1,
        ge=0,
        le=1,
        description="free edges lie this far inside the edge of the roof, as walls stand back from the eaves",
    )


class Reconstruct(Section):
    """Stage reconstruct: buildings from the user's LiDAR and footprints."""

    footprint_schema: SchemaName = Field(
        "auto",
        description="source of the footprints, which defines the columns of ids, heights and storeys; auto = "
        "recognise it from the columns",
    )
    footprint_layer: str = Field(
        "", description="layer of the file of footprints; '' = the first with polygons"
    )
    id_field: str = Field("", description="column with building ids; '' = that of footprint_schema")
    height_field: str = Field(
        "",
        description="column with building heights in metres above the ground; '' = those of footprint_schema",
    )
    height_unit: HeightUnit = Field(
        "", description="unit of the heights of clouds, whatever they state; '' = what they state"
    )
    terrain_unit: HeightUnit = Field(
        "", description="unit of the heights of --terrain, whatever it states; '' = what it states"
    )
    keep_columns: list[str] = Field(
        ["all"], description="columns of the footprints to copy to tables and CityJSON; [all] = all"
    )
    outputs: list[Output] = Field(
        ["cityjsonseq", "gpkg", "report"],
        min_length=1,
        description="output formats to write, besides a JSON summary; of meshes: glb, obj, ply, stl, sionna, helios",
    )
    attribute_names: Literal["p2wss", "3dbag"] = Field(
        "p2wss", description="attribute names: those of p2wss, or those of 3DBAG where 3DBAG has one"
    )
    lods: list[Literal["1.2", "2.0"]] = Field(
        ["2.0"],
        min_length=1,
        description="levels of detail in CityJSON; 1.2 = a block with a flat roof at the 70th percentile of "
        "the roof height",
    )
    per_building: bool = Field(
        False,
        description="also write one file per building, for the formats glb, obj, ply and stl among outputs",
    )
    registration: Literal["auto", "always", "never"] = Field(
        "auto",
        description="move blocks of footprints, by at most 3 m, to where the points clearly show the buildings; auto = "
        "only by 0.7 m or more where the clouds have no class building, always = by any clear shift there, too",
    )
    buffer_m: float = Field(
        1, ge=0, le=20, description="distance from the footprint within which points belong to a building"
    )
    min_num_points: int = Field(
        10,
        ge=1,
        description="buildings with fewer points get a flat roof; without any points, at the height that the "
        "footprint states",
    )
    simplify_m: float = Field(
        0.3,
        ge=0,
        le=5,
        description="replaces scenes.simplify_m for the footprints to reconstruct; 0 = no simplification",
    )
    min_eave_height_m: float = Field(
        1, gt=0, description="lower predicted eave heights are raised to this value"
    )
    max_roof_height_m: float = Field(
        12,
        gt=0,
        description="parametric roofs that would rise further above the eaves are cut off horizontally",
    )
    completion: bool = Field(
        True,
        description="where a roof of planes has fewer than two points per square metre, begin with the roof that a "
        "network supposes between them; needs no torch",
    )
    roofs: Literal["planes", "parametric"] = Field(
        "planes",
        description="planes = roofs of any shape, from the planes that the points show; parametric = the model of the "
        "paper, one eave height and one angle per edge",
    )
    detail: Literal["low", "normal", "high"] = Field(
        "normal",
        description="level of detail, set by the prices of faces and edges: low = fewer triangles, "
        "high = nearer to the points",
    )
    max_triangles: int | None = Field(
        None,
        ge=1,
        description="buildings get the level of detail low, those first that lose the least accuracy per "
        "triangle saved, until all together have at most so many triangles, before skin, without terrain and plants; "
        "null = no limit",
    )
    max_wall_shift_m: float = Field(
        1,
        ge=0,
        le=5,
        description="maximum distance by which a wall moves inwards if the roof does not reach the edge of "
        "the footprint; 0 = no moving",
    )
    not_representable_m: float = Field(
        0.25,
        gt=0,
        description="fitted buildings are flagged if their mean distance from points to mesh is larger",
    )
    outlines: Outlines = Outlines()
    materials: Materials = Materials()
    frequency_ghz: float = Field(
        3.5, gt=0, le=1000, description="frequency for which the materials of a Sionna scene are defined"
    )
    split_materials: bool = Field(
        False,
        description="one shape per material in Sionna scenes, which loses diffraction at the edges between "
        "walls and roofs; "
        "false = one shape per building, with the material of its walls",
    )
    map_cell_m: float = Field(
        2.0,
        gt=0,
        le=100,
        description="cell size of the terrain surface for radio maps in Sionna scenes",
    )
    skin: bool = Field(
        False,
        description="in mesh files, merge the buildings of a block into one closed skin without party walls",
    )
    skin_terrain: Literal["cut", "overlap"] = Field(
        "cut",
        description="with skin and a terrain: cut = walls end on the terrain, which has a hole below "
        "buildings; "
        "overlap = all meshes are closed solids, and walls extend into the terrain",
    )
    vegetation: bool = Field(
        False,
        description="also write trees and clumps of plants, as closed volumes, to mesh files and CityJSON",
    )
    wedges: bool = Field(False, description="also write the convex edges of the skin to a Parquet file")
    terrain_tolerance_m: float = Field(
        0.2, gt=0, le=10, description="vertical tolerance of the triangulated terrain of --terrain"
    )
    terrain_margin_m: float = Field(
        20, ge=0, le=1000, description="margin of the triangulated terrain around the buildings"
    )
    max_failed_fraction: Share = Field(
        0.2,
        description="the command fails, after all files are written, if a larger share of the buildings has the reason "
        "internal-error",
    )
    strict: bool = Field(
        False, description="stop at the first internal error, which otherwise is that of one building only"
    )

    @property
    def writes_parquet(self) -> bool:
        """Whether a file is written that needs the extra ``parquet``."""
        return self.wedges or "geoparquet" in self.outputs

"""Places and tiles: the files of every member and draw of a data set, and the groups that are evaluated together.

A place (wildcard {place}, p2wss.config.places) stands before each tile: "" without members, "paris/" for a member,
"paris/2/" for its second draw.
"""

from p2wss.data.tiling import neighbours, tile_bounds, tiles_of_bounds
from p2wss.data import listing
from p2wss.storage import integrity

MEMBERS = configs.member_places(settings)


@cache
def pinned_tiles(member):
    """The tiles of a member as far as the config alone decides them: named, or all of its bounds."""
    region = at(member).region
    every = region.tiles == [configs.ALL]
    return list(tiles_of_bounds(region.bounds_m, region.tile_size_m)) if every else region.tiles


def rows_of_index(path):
    """The rows (place, tile, number of buildings) of the index of the scenes."""
    try:
        return [line.split("\t") for line in integrity.read_lines(path)[1:]]
    except InputError as error:
        raise WorkflowError(str(error)) from None


# here, because Snakemake adds a traceback to what is wrong in an input function
index_file = f"results/{configs.dataset_name(settings)}/scenes/index.tsv"
if os.path.isfile(index_file) and not all(map(pinned_tiles, MEMBERS)):
    rows_of_index(index_file)


def tiles_of(member):
    """The pinned tiles of a member, or those in which index_scenes found buildings."""
    if pinned := pinned_tiles(member):
        return pinned
    with checkpoints.index_scenes.get().output.index.open() as index:
        rows = rows_of_index(index.name)
    return [tile for place, tile, _ in rows if place == member]


def every_tile(path, draws=True):
    """An input function: ``path`` for every place and tile to simulate; without draws, once per member."""

    def paths(wildcards):
        for member in MEMBERS:
            places = configs.draw_places(settings, member) if draws else [member]
            yield from expand(path, place=places, tile=tiles_of(member), vintage=at(member).region.vintage)

    return lambda wildcards: list(paths(wildcards))


def lidar_tiles_of(member):
    """The tiles of a member whose real LiDAR is used."""
    tiles = at(member).region.lidar_tiles
    return tiles_of(member) if tiles == [configs.ALL] else tiles


def every_lidar_tile(path):
    """An input function: ``path`` for every member and tile with real LiDAR."""
    return lambda wildcards: [
        file for member in MEMBERS for file in expand(path, place=member, tile=lidar_tiles_of(member))
    ]


def of_place(path):
    """An input function: ``path`` with the member and the vintage of the job's place."""
    return lambda wildcards: expand(
        path,
        member=configs.member_place(settings, wildcards.place),
        vintage=at(wildcards.place).region.vintage,
        tile=wildcards.get("tile", ""),
    )


def around(path):
    """An input function: ``path`` of a LiDAR tile and of those of its neighbours that the config lists."""

    def paths(wildcards):
        region = at(wildcards.place).region
        names = [wildcards.tile, *neighbours(wildcards.tile, region.tile_size_m)]
        listed = set(lidar_tiles_of(wildcards.place))  # once: it may read the index of the scenes
        tiles = [name for name in names if name in listed]
        return expand(path, place=wildcards.place, vintage=region.vintage, tile=tiles)

    return paths


def covers(region, tile):
    """Whether a tile lies in the bounds of a region."""
    west, south, east, north = tile_bounds(tile, region.tile_size_m)
    x_min, y_min, x_max, y_max = region.bounds_m
    return west < x_max and east > x_min and south < y_max and north > y_min


def source_of_tile(wildcards):
    """The first member whose source data have this vintage and cover the tile."""
    members = [member for member in MEMBERS if at(member).region.vintage == wildcards.vintage]
    covering = [member for member in members if covers(at(member).region, wildcards.tile)]
    return (covering or members or MEMBERS)[0]


def source_section(wildcards):
    """Sections of the config that say where the data of a tile come from."""
    without = (*TILE_LISTS, *OF_CLOUDS, "prepare")
    return configs.section_json(at(source_of_tile(wildcards)), "region", "fetch", without=without)


# what the files of a source folder are read for, and the endings of their names
SOURCE_SUFFIXES = {"footprints": listing.VECTOR, "dtm": listing.RASTER, "lidar": listing.CLOUD}


@cache
def files_of_folder(location, kind):
    """The files of a source folder with their extents; none if there are none, which the command then says better."""
    try:
        files = listing.list_files(location, SOURCE_SUFFIXES[kind], "")
    except InputError:
        return []
    # read here once: every tile asks for them
    return [(file, listing.extent_m(file)) for file in files]


def source_files(kind, place_of=lambda wildcards: wildcards.place):
    """An input function: the user's files that the footprints of a place, or the dtm or the lidar of a tile, are read from.

    So a replaced file reruns what follows. A town that rule draw_town draws is its output.
    """

    def paths(wildcards):
        place = place_of(wildcards)
        fetch, region = at(place).fetch, at(place).region
        if fetch.source != "folder":
            return []
        location = getattr(fetch.folder, kind)
        if kind != "lidar" and location.startswith("resources/towns/"):
            return [local(location)]
        files = files_of_folder(location, kind)
        in_other_crs = kind == "lidar" and fetch.folder.lidar_crs not in ("", region.crs)
        if kind != "footprints" and not in_other_crs:
            bounds = tile_bounds(wildcards.tile, region.tile_size_m, fetch.margin_m)
            files = [(file, extent) for file, extent in files if listing.may_overlap(extent, bounds)]
        return [local(str(part)) for file, _ in files for part in listing.with_companions(file)]

    return paths


def source_sizes(kind, place_of=lambda wildcards: wildcards.place):
    """A parameter: sizes of the same files, by which a file that an older one replaced is noticed.

    It depends on the wildcards alone: Snakemake does not track parameters that depend on the input.
    """

    def sizes(wildcards):
        files = [str(file) for file in source_files(kind, place_of)(wildcards)]
        delivered = [file for file in files if not file.startswith("resources/towns/")]
        return [os.path.getsize(file) for file in delivered if os.path.isfile(file)]

    return sizes


@cache
def evaluated_shards():
    """All shards in the order of the manifest, cut into the groups of one job each."""
    shards = [*simulated_shards({}), *real_shards({})]
    size = settings.eval.shards_per_job
    return [shards[first : first + size] for first in range(0, len(shards), size)]


def shards_of_group(wildcards):
    return evaluated_shards()[int(wildcards.group)]


def every_group(path):
    """An input function: ``path`` for every group of shards."""
    return lambda wildcards: expand(
        path, group=[f"{number:04d}" for number in range(len(evaluated_shards()))], allow_missing=True
    )

"""Places and tiles: the files of every member and draw of a data set, and the groups that are evaluated together.

A place (wildcard {place}, p2wss.config.places) stands before each tile: "" without members, "paris/" for a member,
"paris/2/" for its second draw.
"""

from p2wss.data.tiling import neighbours, tile_bounds, tiles_of_bounds

MEMBERS = configs.member_places(settings)


@cache
def pinned_tiles(member):
    """The tiles of a member as far as the config alone decides them: named, or all of its bounds."""
    region = at(member).region
    every = region.tiles == [configs.ALL]
    return list(tiles_of_bounds(region.bounds_m, region.tile_size_m)) if every else region.tiles


def tiles_of(member):
    """The pinned tiles of a member, or those in which index_scenes found buildings."""
    if pinned := pinned_tiles(member):
        return pinned
    with checkpoints.index_scenes.get().output.index.open() as index:
        rows = [line.rstrip("\n").split("\t") for line in list(index)[1:]]
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
    without = ("prepare", "sources", "offline")
    return configs.section_json(at(source_of_tile(wildcards)), "region", "fetch", without=without)


def drawn_town(place, kind):
    """The footprints or the terrain of a place, if they are of a town that rule draw_town draws."""
    path = getattr(at(place).fetch.folder, kind)
    return path if at(place).fetch.source == "folder" and path.startswith("resources/towns/") else []


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


def folders_of(name):
    """The folders of the parts, from the paths of an input with this name."""
    return lambda wildcards, input: list(dict.fromkeys(os.path.dirname(path) for path in input[name]))

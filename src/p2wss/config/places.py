"""Places: which folders of a data set hold the files of a member and of a draw.

A place is the part of a path before the name of a tile: "" for a config without members, ``paris/`` for a member with
one draw, ``paris/1/`` and ``paris/2/`` for the draws of a member with several draws. Files that no draw changes, such
as footprints and real LiDAR, are at the place of the member: ``paris/``.
"""

from zlib import crc32

from p2wss.config.base import merge
from p2wss.config.crops import Member
from p2wss.config.region import ALL, TILE_LISTS
from p2wss.config.sections import MEMBER_SECTIONS, Config

PLACE_PATTERN = r"([A-Za-z0-9_-]+/)*"


def dataset_name(config: Config) -> str:
    """Name of the folder of results."""
    return config.dataset.name or config.region.name


def member_places(config: Config) -> list[str]:
    """The place of each member, in the order of the config; ``[""]`` without members."""
    return [f"{member.name}/" for member in config.dataset.members] or [""]


def draw_places(config: Config, member_place: str) -> list[str]:
    """The place of each draw of a member.

    >>> draw_places(Config(), "")
    ['']
    """
    if not member_place:
        return [""]
    member = _member(config, member_place)
    return (
        [f"{member_place}{draw + 1}/" for draw in range(member.draws)] if member.draws > 1 else [member_place]
    )


def member_place(config: Config, place: str) -> str:
    """The place of the member that a place belongs to."""
    return f"{_member(config, place).name}/" if place else ""


def place_config(config: Config, place: str) -> Config:
    """The config of a place: the member's settings are applied, and scenes and scans get seeds of their own.

    The split of the crops has the same seed everywhere: a building is in the same split in every draw. Raises
    ``ValueError`` for a place that the config does not have, pydantic's ``ValidationError`` for a wrong setting.
    """
    if not place:
        return config
    member = _member(config, place)
    sections = config.model_dump(mode="json", exclude={"dataset"})
    for name in TILE_LISTS:
        # names of tiles belong to one region (here the default, the miniature); "all" suits any region
        if sections["region"][name] != [ALL]:
            sections["region"][name] = []
    for name in MEMBER_SECTIONS:
        merge(sections[name], getattr(member, name))
    for name in ("scenes", "scans"):
        sections[name]["seed"] += crc32(place.encode())
    if member.split:
        sections["crops"]["split"] = member.split
    return Config.model_validate(sections)


def _member(config: Config, place: str) -> Member:
    name, _, draw = place.removesuffix("/").partition("/")
    for member in config.dataset.members:
        if member.name == name and (not draw or (draw.isdigit() and 1 <= int(draw) <= member.draws)):
            return member
    raise ValueError(f"no place {place} in the data set")

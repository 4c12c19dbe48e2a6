"""``p2wss view``: buildings of any CityJSON file on a page."""

import webbrowser
from pathlib import Path

import click

from p2wss.cli.common import CITY, city_files, config_option, crs_option, log, sums_of
from p2wss.cli.parser import PATH, Command, option, setting
from p2wss.config import Config
from p2wss.storage import files
from p2wss.storage.messages import InputError


@click.command(cls=Command)
@click.argument(
    "paths",
    type=PATH,
    nargs=-1,
    required=True,
    metavar="FOLDER|FILE .. [CLOUD ..]",
    help="folder of a run, or CityJSON files of any program, which are compared; then clouds of the same place",
)
@option("--out", type=PATH, help="page to write (default: view.html beside the first file)")
@option("--open", "opens", is_flag=True, help="open the page in the browser")
@crs_option
@setting("reconstruct.height_unit")
@config_option
def view(paths: tuple[Path, ...], out: Path | None, opens: bool, crs: str | None, config: Config) -> None:
    """Show buildings in 3D with points and attributes: one HTML page that needs no internet."""
    cities, clouds = [], []
    for path in paths:
        # the reader's error says how to convert CityGML
        if (inside := city_files(path)) or path.suffix in (*CITY, ".gml", ".xml"):
            cities += inside or [path]
        else:
            clouds.append(path)
    if not cities:
        raise InputError(f"{paths[0]}: no CityJSON file, nor a folder with one (.city.json, .city.jsonl)")
    page, *others = {each.with_name(each.stem.removesuffix(".city") + ".html") for each in cities}
    is_one_run = len(paths) == 1 and paths[0].is_dir() and not others
    # the page of a run also has the points, and how footprints were moved; the page of an earlier run has other
    # buildings
    if not (is_one_run and out is None and _are_of_one_run(page, cities[0])):
        page = out or cities[0].with_name("view.html")
        files.write_text(page, _page(cities, clouds, crs, config.reconstruct.height_unit))
    log.info("open %s in a browser", page)
    if opens:
        webbrowser.open(page.resolve().as_uri())


def _are_of_one_run(*paths: Path) -> bool:
    """Whether all files have the checksums in the summary beside them, which is named after the first file."""
    sums = sums_of(paths[0].with_suffix(".json"))["sha256"]
    return all(path.exists() and sums.get(path.name) == files.sha256(path) for path in paths)


def _page(cities: list[Path], clouds: list[Path], crs: str | None, height_unit: str) -> str:
    import p2wss
    from p2wss.data.crs import check_crs
    from p2wss.reconstruction.inputs import read_cloud_of
    from p2wss.reconstruction.outputs.page import page_of_scenes

    names = {
        path.name if len({each.name for each in cities}) == len(cities) else str(path): path
        for path in cities
    }
    scenes = {name: p2wss.read(path) for name, path in names.items()}
    first = next(iter(scenes.values()))
    for path, scene in zip(cities, scenes.values(), strict=True):
        check_crs(scene.crs, first.crs, path, f"{cities[0]} is", "reproject one of them")
    if not clouds:
        return page_of_scenes(", ".join(names), scenes, None)
    cloud, conversion = read_cloud_of(first.crs, first.bounds, str(cities[0]), clouds, crs, height_unit)
    if conversion is not None:
        scenes = {name: scene.converted(conversion) for name, scene in scenes.items()}
    return page_of_scenes(", ".join(names), scenes, cloud)

"""A report over data whose names would be elements and scripts, looked at in a browser."""

from __future__ import annotations

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
import yaml

from p2wss import cli
from p2wss.eval.cases import RECONSTRUCTIONS
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
HOSTILE = (
    "</script><script>document.title='owned'</script>",
    '"><img src=x onerror="document.title=\'owned\'">',
    "'><svg onload=document.title='owned'>",
    "{{ 7 * 7 }}{% raw %} $\\frac{ & \\input{x}",
)


@pytest.fixture(scope="module")
def hostile_page(hamlet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    for name in ("a", "b"):
        table = files.read_table(hamlet.parent / f"{name}.parquet", CROPS)
        columns = {column: table[column].to_pylist() for column in table.column_names}
        rows = range(len(table))
        columns["building_id"] = [f"{HOSTILE[i % 4]}{i}" for i in rows]
        columns["roof_type"] = [None if value is None else HOSTILE[0] for value in columns["roof_type"]]
        files.write_table(folder / f"{name}.parquet", columns, CROPS, {"crs": HOSTILE[1]})
    listing = files.read_json(hamlet) | {"version": HOSTILE[0], "code": HOSTILE[1]}
    files.write_json(folder / "manifest.json", listing)
    settings = {"eval": {"lidar_name": HOSTILE[0], "attribution": list(HOSTILE)}}
    files.write_text(folder / "config.yaml", yaml.safe_dump(settings))
    manifest = ["--manifest", folder / "manifest.json"]
    config = ["--config", folder / "config.yaml"]

    def run(*arguments: object) -> None:
        assert cli.main(["eval", *map(str, [*arguments, *config])]) == 0

    rows = [folder / f"{name}.parquet" for name in ("fit", "lod1")]
    for path in rows:
        run("reconstruct", "--method", path.stem, *manifest, "--out", path)
    facts = files.read_metadata(rows[0]) | {"note": HOSTILE[1]}
    table = files.read_table(rows[0], RECONSTRUCTIONS)
    with files.table_writer(rows[0], RECONSTRUCTIONS) as writer:
        writer.append_table(table)
        writer.metadata = facts
    measures = folder / "measures.parquet"
    run("measure", *manifest, "--reconstructions", *rows, "--out", measures)
    metrics = folder / HOSTILE[2].replace("/", "") / "metrics.jsonl"
    files.write_text(metrics, "".join(json.dumps({"step": i, HOSTILE[3]: 9.0}) + "\n" for i in range(3)))
    inputs = ["--measures", measures, "--reconstructions", *rows, "--metrics", metrics]
    run("report", "--out", folder, *manifest, *inputs)
    return folder / "report.html"


def test_no_name_from_the_data_is_an_element_of_the_page(hostile_page: Path) -> None:
    page = hostile_page.read_text(encoding="utf-8")
    assert "&lt;/script&gt;" in page and "{{ 7 * 7 }}" in page and ">49" not in page
    for text in HOSTILE[:3]:
        assert text not in page
    # the view's data, three.js and its script, and no other
    assert len(re.findall(r"<script\b", page)) == len(re.findall(r"</script>", page)) == 3
    handlers: list[str] = []
    parser = HTMLParser()
    parser.handle_starttag = lambda _, attributes: handlers.extend(
        name for name, _ in attributes if name[:2] == "on"
    )
    parser.feed(page)
    assert not handlers


def test_a_browser_runs_nothing_of_the_data(hostile_page: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    options = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=CHROMIUM, args=options)
        page = browser.new_page(viewport={"width": 1000, "height": 800})
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(hostile_page.as_uri())
        page.wait_for_timeout(500)
        title, text = page.title(), page.inner_text("body")
        page.screenshot(path=str(hostile_page.with_suffix(".png")))
        handlers = page.evaluate(
            "[...document.querySelectorAll('*')].flatMap(e => [...e.attributes])"
            ".filter(a => a.name.startsWith('on')).length"
        )
        browser.close()
    assert "owned" not in title and handlers == 0 and not errors
    assert HOSTILE[0] in text and HOSTILE[1] in text  # shown as they are

"""The page that maps the shifts of footprints: what is drawn and listed, and that nothing of the data is markup."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import pytest
import shapely
from shapely import affinity

from p2wss.formats import shift_map
from p2wss.formats.shift_map import LEGEND, MOVED, STAYED, UNKNOWN, Block, Footprint
from p2wss.formats.viewer import scene_page

HOSTILE = "</title><script>document.title='owned'</script>{{ 7 * 7 }}"


def square(x: float) -> shapely.Polygon:
    return shapely.box(x, 0, x + 10, 10)


def page_of(footprints: list[Footprint], blocks: dict[str, Block], title: str = "x", crs: str = "y") -> str:
    return scene_page(title, ["5 buildings"], [], [], shift_map.content(crs, footprints, blocks))


@pytest.fixture(scope="module")
def page() -> str:
    footprints = [
        Footprint("A", "A", square(0), affinity.translate(square(0), 0.6, -0.8)),
        Footprint("B", "A", square(10), affinity.translate(square(10), 0.6, -0.8), ("extended",), 0.0, 42.0),
        Footprint(HOSTILE, HOSTILE, square(40), square(40)),
        Footprint("D", "D", square(80), square(80)),
        Footprint("empty", "", shapely.Polygon(), shapely.Polygon()),
    ]
    blocks = {
        "A": Block(MOVED, 0.6, -0.8, 0.07, 0.31),
        HOSTILE: Block(STAYED, 0.0, 0.0, 0.2, -0.1),
        "D": Block(UNKNOWN, 0.0, 0.0, None, None),
    }
    return page_of(footprints, blocks, HOSTILE, "Lambert & Co")


def map_of(page: str) -> ET.Element:
    text = re.search(r'<svg class="map".*?</svg>', page, re.S)
    assert text is not None
    return ET.fromstring(text[0])


def test_nothing_of_the_data_is_markup(page: str) -> None:
    assert "<script" not in page and "{{ 7 * 7 }}" in page and ">49" not in page
    assert page.count("&lt;/title&gt;&lt;script&gt;") >= 4 and "Lambert &amp; Co" in page


def test_an_arrow_per_block_that_moved_in_the_colour_of_what_was_done(page: str) -> None:
    root = map_of(page)
    arrows = [line for line in root.iter("line") if "marker-end" in line.attrib]
    assert len(arrows) == 1 and arrows[0].get("stroke") == LEGEND[MOVED][0]
    start, end = ([float(arrows[0].get(f"{axis}{k}", "")) for axis in "xy"] for k in (1, 2))
    factor = int(re.search(r"drawn (\d+) times", page)[1])  # type: ignore[index]
    # y points down on a page
    assert end[0] - start[0] == pytest.approx(0.6 * factor, abs=0.02)
    assert end[1] - start[1] == pytest.approx(0.8 * factor, abs=0.02)
    # 5 times would be less than it could be, 10 times more than 8 % of 97 m
    assert factor == 5


def test_footprints_before_and_after(page: str) -> None:
    root = map_of(page)
    drawn = [path for path in root.findall("path") if path.get("fill") != "none"]
    assert [path.find("title").text for path in drawn] == ["A", "B", HOSTILE, "D"]  # type: ignore[union-attr]
    colors = [LEGEND[action][0] for action in (MOVED, MOVED, STAYED, UNKNOWN)]
    assert [path.get("stroke") for path in drawn] == colors
    # only those that were moved have a place where they were
    assert len([path for path in root.findall("path") if path.get("fill") == "none"]) == 2
    first = [tuple(map(float, pair.split(","))) for pair in (drawn[0].get("d") or "")[1:-1].split("L")]
    corner = min(x for x, _ in first), max(y for _, y in first)
    before = root.findall("path")[0].get("d") or ""
    input_x = min(float(pair.split(",")[0]) for pair in before[1:-1].split("L"))
    assert corner[0] - input_x == pytest.approx(0.6, abs=0.011)


def test_tables(page: str) -> None:
    rows = [re.sub(r"<[^>]+>", "|", row) for row in re.findall(r"<tr><td.*?</tr>", page)]
    cells = [[cell for cell in row.split("|") if cell] for row in rows]
    assert cells[0] == ["A and 1 more", "0.60", "-0.80", "0.07", "0.31", MOVED]
    assert cells[1][1:] == ["0.00", "0.00", "0.20", "-0.10", STAYED]
    assert cells[2] == ["D", "0.00", "0.00", "–", "–", UNKNOWN]
    assert cells[3] == ["B", "extended", "0", "42"]
    assert re.findall(r"</svg>(\d+) blocks? ", page) == ["1", "1", "1"]


def test_a_run_without_footprints() -> None:
    assert "<table>" in page_of([], {})


def test_long_lists_are_cut() -> None:
    footprints = [Footprint(f"f{i}", f"f{i}", square(20 * i), square(20 * i)) for i in range(2100)]
    blocks = {f"f{i}": Block(STAYED, 0.0, 0.0, 0.1, 0.1) for i in range(2100)}
    page = page_of(footprints, blocks)
    assert page.count("<tr><td") == 2000 and "100 more blocks" in page

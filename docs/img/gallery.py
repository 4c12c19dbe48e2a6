"""The pictures of docs/gallery.md: pages of runs on drawn towns, each with other colours (docs/img/gallery_*.png).

python docs/img/gallery.py RUNS docs/img [CHROMIUM]     (needs Playwright and a Chromium)

RUNS is the folder in which the commands of docs/gallery.md ran.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from PIL import Image
from playwright.sync_api import sync_playwright

SIZE = (760, 460)
# sets checkboxes and colours, and enlarges the canvas of the page to the whole window
SETUP = """([shown, paint]) => {
  for (const box of document.querySelectorAll("#viewer input[type=checkbox]"))
    if (box.checked !== shown.includes(box.name)) box.click();
  const select = document.querySelector("#viewer select.paint");
  select.value = paint;
  select.dispatchEvent(new Event("change"));
  const canvas = document.querySelector("#viewer canvas");
  document.body.replaceChildren(canvas);
  document.body.style.cssText = "margin:0; padding:0; max-width:none";
  canvas.style.cssText = "width:100vw; height:100vh; margin:0; outline:0";
  canvas.focus();
}"""


class Picture(NamedTuple):
    """page: of a run. shown: checkboxes. paint: colours of the meshes. zoom: how often the key + is pressed."""

    page: Path
    shown: tuple[str, ...]
    paint: str = "kind"
    zoom: int = 2


_DEMO, _WINGS, _LARGE, _OLD = (
    Path(name)
    for name in (
        "p2wss-demo/out/lidar.html",
        "wings-out/wings.html",
        "large-out/large.html",
        "old-out/old.html",
    )
)
GALLERY = {
    "demo_points": Picture(_DEMO, ("points",), zoom=0),
    "demo": Picture(_DEMO, ("p2wss",)),
    "roof_types": Picture(_DEMO, ("p2wss", "ground"), "roof"),
    "wings": Picture(_WINGS, ("p2wss", "ground"), zoom=4),
    "heights": Picture(_WINGS, ("p2wss", "ground"), "height"),
    "large": Picture(_LARGE, ("p2wss", "ground"), zoom=1),
    "old": Picture(_OLD, ("p2wss",)),
    "old_residual": Picture(_OLD, ("p2wss",), "residual"),
}


def drawn(
    pictures: Iterable[Picture], size: tuple[int, int], executable: str | None
) -> Iterator[Image.Image]:
    """Each picture, in the size of the window."""
    with sync_playwright() as playwright:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=executable, args=options)
        for picture in pictures:
            page = browser.new_page(viewport={"width": size[0], "height": size[1]})
            page.goto(picture.page.resolve().as_uri())
            page.evaluate(SETUP, [picture.shown, picture.paint])
            page.wait_for_timeout(500)
            page.keyboard.press("Home")  # the whole of the town in the new size of the picture
            for _ in range(picture.zoom):
                page.keyboard.press("+")
            page.wait_for_timeout(1000)
            yield Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            page.close()
        browser.close()


def main(runs: Path, out: Path, executable: str | None) -> None:
    """Draw each picture."""
    pictures = [each._replace(page=runs / each.page) for each in GALLERY.values()]
    for name, image in zip(GALLERY, drawn(pictures, SIZE, executable), strict=True):
        image.quantize(96, dither=Image.Dither.NONE).save(out / f"gallery_{name}.png", optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None)

"""The pictures of docs/gallery.md: pages of runs on drawn towns, each with other colours (docs/img/gallery_*.png).

python docs/img/gallery.py RUNS docs/img [CHROMIUM]     (needs Playwright and a Chromium)

RUNS is the folder in which the commands of docs/gallery.md ran.
"""

from __future__ import annotations

import io
import sys
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

    page: str
    shown: tuple[str, ...]
    paint: str = "kind"
    zoom: int = 2


GALLERY = {
    "demo_points": Picture("p2wss-demo/out/lidar.html", ("points",), zoom=0),
    "demo": Picture("p2wss-demo/out/lidar.html", ("p2wss",)),
    "roof_types": Picture("p2wss-demo/out/lidar.html", ("p2wss", "ground"), "roof"),
    "wings": Picture("wings-out/wings.html", ("p2wss", "ground"), zoom=4),
    "heights": Picture("wings-out/wings.html", ("p2wss", "ground"), "height"),
    "old": Picture("old-out/old.html", ("p2wss",)),
    "old_residual": Picture("old-out/old.html", ("p2wss",), "residual"),
}


def main(runs: Path, out: Path, executable: str | None) -> None:
    """Draw each picture."""
    with sync_playwright() as playwright:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=executable, args=options)
        for name, picture in GALLERY.items():
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.goto((runs / picture.page).resolve().as_uri())
            page.evaluate(SETUP, [picture.shown, picture.paint])
            page.wait_for_timeout(500)
            page.keyboard.press("Home")  # the whole of the town in the new size of the picture
            for _ in range(picture.zoom):
                page.keyboard.press("+")
            page.wait_for_timeout(1000)
            drawn = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            drawn.quantize(96, dither=Image.Dither.NONE).save(out / f"gallery_{name}.png", optimize=True)
            page.close()
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None)

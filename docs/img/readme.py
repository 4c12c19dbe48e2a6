"""The picture of the README: the points of a scene, its meshes, and a radio map over it (docs/img/radio_map.png).

p2wss reconstruct ahn3.laz footprints.gpkg out
python docs/img/readme.py out/ahn3.html docs/img/readme.png     (needs Playwright and a Chromium)
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

SIZE = (600, 440)
# enlarges the canvas of the page to the whole window, and hides the ground, and the points or the meshes
SETUP = """(hidden) => {
  for (const name of [hidden, "ground"]) document.querySelector(`#viewer input[name=${name}]`).click();
  const canvas = document.querySelector("#viewer canvas");
  document.body.replaceChildren(canvas);
  document.body.style.cssText = "margin:0; padding:0; max-width:none";
  canvas.style.cssText = "width:100vw; height:100vh; margin:0; outline:0";
  canvas.focus();
}"""


def main(page_of_run: Path, out: Path) -> None:
    """Put the three pictures side by side."""
    pictures = []
    with sync_playwright() as playwright:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        executable = sys.argv[3] if len(sys.argv) > 3 else None
        browser = playwright.chromium.launch(executable_path=executable, args=options)
        for hidden in ("p2wss", "points"):
            page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
            page.goto(page_of_run.resolve().as_uri())
            page.evaluate(SETUP, hidden)
            page.wait_for_timeout(500)
            page.keyboard.press("Home")  # the whole of the town in the new size of the picture
            page.wait_for_timeout(1000)
            pictures.append(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
        browser.close()
    radio = Image.open(Path(__file__).with_name("radio_map.png")).convert("RGB")
    radio = radio.crop((110, 0, 110 + round(545 * SIZE[0] / SIZE[1]), 545)).resize(
        SIZE, Image.Resampling.LANCZOS
    )
    whole = Image.new("RGB", (3 * SIZE[0], SIZE[1]), "white")
    for number, picture in enumerate([*pictures, radio]):
        whole.paste(picture, (number * SIZE[0], 0))
    whole.quantize(128).save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

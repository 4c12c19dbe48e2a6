"""The picture of the README: the points of a scene, its meshes, and a radio map over it (docs/img/radio_map.png).

p2wss reconstruct ahn3.laz footprints.gpkg out
python docs/img/readme.py out/ahn3.html docs/img/readme.png     (needs Playwright and a Chromium)
"""

from __future__ import annotations

import sys
from pathlib import Path

from gallery import Picture, drawn
from PIL import Image

SIZE = (600, 440)


def radio_map(path: Path) -> Image.Image:
    """The middle of that picture above its scale."""
    image = Image.open(path).convert("RGB")
    width, height = SIZE
    scale = image.crop((0, 548, *image.size))
    scale = scale.resize((width, round(scale.height * width / scale.width)), Image.Resampling.LANCZOS)
    high = height - scale.height
    middle = image.crop((110, 0, 110 + round(545 * width / high), 545))
    result = Image.new("RGB", SIZE, "white")
    result.paste(middle.resize((width, high), Image.Resampling.LANCZOS), (0, 0))
    result.paste(scale, (0, high))
    return result


def main(page_of_run: Path, out: Path, executable: str | None) -> None:
    """Put the three pictures side by side."""
    pictures = list(
        drawn([Picture(page_of_run, (shown,), zoom=0) for shown in ("points", "p2wss")], SIZE, executable)
    )
    pictures.append(radio_map(Path(__file__).with_name("radio_map.png")))
    whole = Image.new("RGB", (3 * SIZE[0], SIZE[1]), "white")
    for number, picture in enumerate(pictures):
        whole.paste(picture, (number * SIZE[0], 0))
    whole.quantize(128).save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None)

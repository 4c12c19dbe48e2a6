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


def main(page_of_run: Path, out: Path, executable: str | None) -> None:
    """Put the three pictures side by side."""
    pictures = list(
        drawn([Picture(page_of_run, (shown,), zoom=0) for shown in ("points", "p2wss")], SIZE, executable)
    )
    radio = Image.open(Path(__file__).with_name("radio_map.png")).convert("RGB")
    radio = radio.crop((110, 0, 110 + round(545 * SIZE[0] / SIZE[1]), 545)).resize(
        SIZE, Image.Resampling.LANCZOS
    )
    whole = Image.new("RGB", (3 * SIZE[0], SIZE[1]), "white")
    for number, picture in enumerate([*pictures, radio]):
        whole.paste(picture, (number * SIZE[0], 0))
    whole.quantize(128).save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else None)

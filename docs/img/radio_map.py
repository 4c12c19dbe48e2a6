"""The picture of docs/manual/simulation.md: path gain 1.5 m above the ground, by an interpreter that has Sionna RT.

python docs/img/radio_map.py out/ahn3_sionna docs/img/radio_map.png
"""

from __future__ import annotations

import sys
from io import BytesIO
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import mitsuba as mi
import numpy as np
from PIL import Image
from sionna import rt

LOW_DB, HIGH_DB = -110, -60


def main(folder: Path, out: Path) -> None:
    """Render the scene of a folder with a map of path gain, and a scale below."""
    scene = rt.load_scene(str(folder / "scene.xml"), merge_shapes=False)
    scene.frequency = 3.5e9
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Transmitter("tx", position=[52, 60, 20], display_radius=1.2))
    lifted = mi.ScalarTransform4f().translate([0, 0, 1.5])
    top = str(folder / "terrain_top.ply")
    surface = mi.load_dict({"type": "ply", "filename": top, "to_world": lifted})
    radio_map = rt.RadioMapSolver()(
        scene, measurement_surface=surface, max_depth=4, diffraction=True, samples_per_tx=10_000_000
    )
    gain = np.array(radio_map.path_gain)
    print(gain.shape, f"{(gain > 0).mean():.3f} of the cells have a path")
    camera = rt.Camera(position=[-35, -75, 120], look_at=[70, 82, 0])
    figure = scene.render(
        camera=camera,
        radio_map=radio_map,
        rm_vmin=LOW_DB,
        rm_vmax=HIGH_DB,
        resolution=(1000, 560),
        num_samples=128,
        show_devices=True,
        return_bitmap=True,
    )
    rgba = figure.convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.UInt8, srgb_gamma=True)
    picture = Image.fromarray(np.array(rgba), "RGBA")
    image = Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture).convert("RGB")
    plot, axes = plt.subplots(2, figsize=(10, 6.1), height_ratios=[56, 1.2], layout="constrained")
    axes[0].imshow(image)
    axes[0].axis("off")
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(LOW_DB, HIGH_DB), "viridis")
    plot.colorbar(scale, cax=axes[1], orientation="horizontal", label="path gain 1.5 m above ground, dB")
    memory = BytesIO()
    plot.savefig(memory, dpi=100)
    Image.open(memory).convert("RGB").quantize(256, kmeans=1).save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

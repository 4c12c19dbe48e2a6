"""A scene for HELIOS++, which simulates laser scanning: a folder with XML, one OBJ per mesh and their materials.

``helios --assets STEM_helios SURVEY.xml`` finds the files; the survey names the scene as ``scene.xml#scene``. Format:
documentation of HELIOS++ (https://github.com/3dgeo-heidelberg/helios), pages "Scene" and "Materials".
"""

import re
from collections.abc import Sequence
from xml.sax.saxutils import quoteattr

from p2wss import __version__
from p2wss.formats.materials import MATERIALS
from p2wss.formats.meshes import Body, Frame, file_names, material_names, mtl, obj

# classes of LAS
_GROUND, _HIGH_VEGETATION, _BUILDING = 2, 5, 6
# the nearest spectrum of HELIOS++ for a material, by its name or type; without a spectrum, HELIOS++ reflects 50 %
_SPECTRA = {
    "concrete": "cement_cinderblock",
    "plasterboard": "cement_cinderblock",
    "marble": "cement_cinderblock",
    "brick": "shingle_red",
    "slate": "shingle_gray",
    "metal": "aluminum",
    "wood": "wood",
    "chipboard": "wood",
    "plywood": "wood",
    "very_dry_ground": "grass_dry",
    "medium_dry_ground": "grass",
    "wet_ground": "grass",
}


def scene_files(bodies: Sequence[Body], frame: Frame) -> dict[str, bytes]:
    """The contents of the files by their names, relative to the folder; ``scene.xml`` is the last.

    Every mesh is a part of the scene, so that simulated points tell their mesh (``hitObjectId``). Its material states
    the LAS class of points on it.
    """
    names = file_names([re.sub(r"[^A-Za-z0-9_-]", "_", body.name) for body in bodies])
    files, parts = {}, []
    for number, (body, name) in enumerate(zip(bodies, names, strict=True), 1):
        files[f"meshes/{name}.obj"] = obj([body], frame, f"{name}.mtl")
        files[f"meshes/{name}.mtl"] = mtl(
            [body], {each: _lines(body, each) for each in material_names([body])}
        )
        parts += [
            f'        <part id="{number}">',
            '            <filter type="objloader">',
            f'                <param type="string" key="filepath" value={quoteattr(f"meshes/{name}.obj")}/>',
            '                <param type="string" key="up" value="z"/>',
            "            </filter>",
            "        </part>",
        ]
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f"<!-- p2wss {__version__}; metres; crs {frame.crs}; origin_m {frame.origin} (add it to every point) -->",
        "<document>",
        '    <scene id="scene" name="p2wss">',
        *parts,
        "    </scene>",
        "</document>",
    ]
    files["scene.xml"] = ("\n".join(lines) + "\n").encode()
    return files


def _lines(body: Body, name: str) -> list[str]:
    """The lines of HELIOS++ for a material: the class of points, whether scanners may stand on it, and the spectrum."""
    itu_type = MATERIALS[name].itu_type
    is_ground = body.is_terrain or itu_type.endswith("_ground")
    number = _HIGH_VEGETATION if body.is_plant else _GROUND if is_ground else _BUILDING
    spectrum = "deciduous" if body.is_plant else _SPECTRA.get(name, _SPECTRA.get(itu_type))
    return [
        f"helios_classification {number}",
        f"helios_isGround {str(is_ground and not body.is_plant).lower()}",
        *([] if spectrum is None else [f"helios_spectra {spectrum}"]),
    ]

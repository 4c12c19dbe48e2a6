"""The geometry kernel: footprints, angles and heights to closed LoD2 meshes."""

from p2wss.skeleton.batch import Diagnosis, build, diagnose, faces, lines
from p2wss.skeleton.clean import Cleaned, clean
from p2wss.skeleton.line_kinds import LineKind
from p2wss.skeleton.queries import RoofPoints, roof_height, roof_points
from p2wss.skeleton.status import Status
from p2wss.skeleton.types import FaceKind, Faces, Lines, Meshes, Polygons

__all__ = [
    "Cleaned",
    "Diagnosis",
    "FaceKind",
    "Faces",
    "LineKind",
    "Lines",
    "Meshes",
    "Polygons",
    "RoofPoints",
    "Status",
    "build",
    "clean",
    "diagnose",
    "faces",
    "lines",
    "roof_height",
    "roof_points",
]

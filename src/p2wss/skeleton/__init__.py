"""The geometry kernel: footprints, angles and heights to closed LoD2 meshes."""

from p2wss.skeleton.batch import build
from p2wss.skeleton.clean import Cleaned, clean
from p2wss.skeleton.status import Status
from p2wss.skeleton.types import FaceKind, Meshes, Polygons

__all__ = ["Cleaned", "FaceKind", "Meshes", "Polygons", "Status", "build", "clean"]

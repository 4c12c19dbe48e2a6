"""Outputs of an earlier run of Roofer, parsed once for all groups of shards."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from p2wss.formats import cityjson_read
from p2wss.formats.cityjson_read import ReadSolid
from p2wss.mesh import Mesh
from p2wss.storage import files
from p2wss.storage.schemas.crops import CROPS, REAL
from p2wss.storage.schemas.manifest import Manifest
from p2wss.storage.schemas.recording import RECORDING

ID_FIELD = "building_id"


@dataclass(frozen=True)
class Recording:
    """A file of :func:`write_recording`.

    names: of the files that it was made of. sha256: the beginnings of their hashes. num_evaluated: how many of the
    evaluated buildings are in it; with none, the files are of another place.
    """

    path: Path
    names: str
    sha256: str
    num_evaluated: int

    def solids(self, building_ids: Collection[str]) -> dict[str, ReadSolid]:
        """The recorded ones of these buildings, by id."""
        select = files.rows_with([ID_FIELD], {(name,) for name in building_ids})
        table = files.read_rows(self.path, RECORDING, [ID_FIELD], select)
        lists = {name: files.list_column(table, name) for name in RECORDING.names[1:]}
        solids = {}
        for i, name in enumerate(table[ID_FIELD].to_pylist()):
            vertex, triangle, kind, surface = (
                values[offset[i] : offset[i + 1]] for values, offset in lists.values()
            )
            mesh = Mesh(vertex.reshape(-1, 3), triangle.reshape(-1, 3), kind, surface)
            solids[name] = ReadSolid(name, mesh, {})
        return solids


def write_recording(paths: Sequence[Path], manifest: Manifest, out: Path) -> Recording:
    """Write the solids of CityJSON files, or CityJSONSeq; of a building in several files the last one.

    A building is identified by the attribute ``building_id``, or else by its name in the file. Raises
    :class:`InputError` if a file is missing or not CityJSON.
    """
    solids: dict[str, ReadSolid] = {}
    for path in paths:
        for solid in cityjson_read.read(path):
            solids[str(solid.attributes.get(ID_FIELD, solid.building_id))] = solid
    ordered = sorted(solids.items())
    columns = {
        ID_FIELD: [name for name, _ in ordered],
        "vertex_xyz_m": [solid.mesh.vertex_m.ravel() for _, solid in ordered],
        "triangle": [solid.mesh.triangle.ravel() for _, solid in ordered],
        "triangle_kind": [solid.mesh.kind for _, solid in ordered],
        "triangle_surface": [solid.mesh.label for _, solid in ordered],
    }
    facts = {
        "names": ", ".join(path.name for path in paths),
        "sha256": " ".join(files.sha256(path)[:16] for path in paths),
        "num_evaluated": _num_evaluated(manifest, solids.keys()),
    }
    files.write_table(out, columns, RECORDING, files.provenance(**facts))
    return read_recording(out)


def read_recording(path: Path) -> Recording:
    """Open a file of :func:`write_recording`. Raises :class:`InputError` if it is missing or something else."""
    facts = files.read_metadata(path)
    return Recording(path, facts["names"], facts["sha256"], facts["num_evaluated"])


def _num_evaluated(manifest: Manifest, names: Collection[str]) -> int:
    count = 0
    for shard in manifest.shards:
        if shard.dataset == REAL:
            table = files.read_table(shard.verified(), CROPS, columns=["split", "tile", ID_FIELD])
            table = table.filter(pa.array(manifest.select(table, REAL, ["test"])))
            count += len(set(table[ID_FIELD].to_pylist()) & set(names))
    return count

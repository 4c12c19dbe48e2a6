"""Files of OpenStreetMap, as XML and as PBF, by their specifications: no library here writes them."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

Ways = Mapping[int, tuple[np.ndarray, Mapping[str, str]]]


def write_xml(path: Path, ways: Ways) -> Path:
    """ways: by id, longitudes and latitudes (n, 2) of a closed ring, without its last corner, and tags."""
    nodes, lines = [], []
    for number, (ring, tags) in ways.items():
        refs = [100 * number + k for k in range(len(ring))]
        nodes += [
            f'<node id="{ref}" version="1" lat="{lat:.9f}" lon="{lon:.9f}"/>'
            for ref, (lon, lat) in zip(refs, ring, strict=True)
        ]
        inner = [f'<nd ref="{ref}"/>' for ref in [*refs, refs[0]]]
        inner += [f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in tags.items()]
        lines.append(f'<way id="{number}" version="1">{"".join(inner)}</way>')
    path.write_text(
        f'<?xml version="1.0"?><osm version="0.6">{"".join(nodes + lines)}</osm>', encoding="utf-8"
    )
    return path


def _varint(value: int) -> bytes:
    result = bytearray()
    while value > 0x7F:
        result.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*result, value])


def _signed(value: int) -> bytes:
    return _varint(2 * value if value >= 0 else -2 * value - 1)


def _field(number: int, value: bytes | int) -> bytes:
    if isinstance(value, int):
        return _varint(8 * number) + _varint(value)
    return _varint(8 * number + 2) + _varint(len(value)) + value


def _signed_field(number: int, value: int) -> bytes:
    return _varint(8 * number) + _signed(value)


def _blob(kind: bytes, content: bytes) -> bytes:
    blob = _field(1, content)
    header = _field(1, kind) + _field(3, len(blob))
    return struct.pack(">I", len(header)) + header + blob


def write_pbf(path: Path, ways: Ways) -> Path:
    """The same as PBF, uncompressed (https://wiki.openstreetmap.org/wiki/PBF_Format)."""
    texts: list[str] = [""]
    nodes, lines = b"", b""

    def number_of(text: str) -> int:
        if text not in texts:
            texts.append(text)
        return texts.index(text)

    def packed(values: Sequence[str]) -> bytes:
        return b"".join(_varint(number_of(each)) for each in values)

    for number, (ring, tags) in ways.items():
        refs = [100 * number + k for k in range(len(ring))]
        for ref, place in zip(refs, np.round(ring * 1e7).astype(int).tolist(), strict=True):
            nodes += _field(
                1, _signed_field(1, ref) + _signed_field(8, place[1]) + _signed_field(9, place[0])
            )
        steps = np.diff([0, *refs, refs[0]]).tolist()
        lines += _field(
            3,
            _field(1, number)
            + _field(2, packed(list(tags)))
            + _field(3, packed(list(tags.values())))
            + _field(8, b"".join(map(_signed, steps))),
        )
    table = _field(1, b"".join(_field(1, each.encode()) for each in texts))
    content = table + _field(2, nodes) + _field(2, lines)
    head = _field(4, b"OsmSchema-V0.6")
    path.write_bytes(_blob(b"OSMHeader", head) + _blob(b"OSMData", content))
    return path

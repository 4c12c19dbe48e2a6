"""Whether the solids of a CityJSON file are valid."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from p2wss.formats import cityjson_read
from p2wss.mesh.rules import MEANINGS, breaches
from p2wss.storage.errors import InputError


@dataclass(frozen=True)
class Validity:
    """num_solids: of the file. invalid: by the name of each invalid solid, with its level of detail, the rules that it
    breaks: codes of val3dity with their meaning."""

    num_solids: int
    invalid: dict[str, list[str]]


def check_file(path: str | Path) -> Validity:
    """Check all solids against the rules of ISO 19107 (:mod:`p2wss.mesh.rules`), with the default tolerances of
    val3dity.

    Raises :class:`InputError` for a file that is missing, broken or without solids.
    """
    num_solids, codes = 0, defaultdict(set)
    for shell in cityjson_read.shells(path):
        num_solids += shell.number == 0
        name = f"{shell.name} (LoD {shell.lod})" if shell.lod else shell.name
        for breach in breaches(shell.vertex_m, shell.surfaces, is_outer=shell.number == 0):
            codes[name].add(breach.code)
    if not num_solids:
        raise InputError(f"{path}: has no solids to check")
    invalid = {
        name: [f"{code} {MEANINGS[code]}" for code in sorted(numbers)] for name, numbers in codes.items()
    }
    return Validity(num_solids, invalid)

"""Draw a town: footprints and terrain as with ``p2wss towns``, stand-in LiDAR, and the true roofs.

    python benchmarks/towns.py --kind wings --seed 8 --lidar --out FOLDER

Needs no data. It is no claim: the benchmarks measure on such towns, and the shipped networks were trained on them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from drawn_towns.files import KINDS, write_town


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kind",
        choices=KINDS,
        required=True,
        help="wings: houses whose roofs consist of several bodies; terraces: rows of such houses; old: tall ones wall "
        "to wall; large: schools, convents, factories, .. of up to some 50 planes; complexes: several of them grown "
        "together, of 50 to 300 planes; streets: as of p2wss towns, without true roofs",
    )
    parser.add_argument("--seed", type=int, required=True, help="each seed from 0 on gives a different town")
    parser.add_argument(
        "--lidar", action="store_true", help="also simulate stand-in LiDAR for tile 0653_6861"
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="output folder, with bdtopo/, rgealti/, lidar/ and roofs/"
    )
    options = parser.parse_args()
    if options.seed < 0:
        parser.error("--seed: 0 or more")
    town = write_town(options.out, options.seed, options.kind, options.lidar)
    print(f"{options.out}: town {options.seed} with {len(town)} buildings")


if __name__ == "__main__":
    main()

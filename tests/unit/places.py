"""Where the checkout and the optional real data are."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
MINI = ROOT / "tests" / "mini"
SHARED = ROOT.parent / "shared"  # real data, beside the checkout where there is any

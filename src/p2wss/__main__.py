"""``python -m p2wss``."""

import sys

from p2wss.cli import main

if __name__ == "__main__":
    sys.exit(main())

"""Generate the files in ``config/``: ``python -m p2wss.config [FOLDER]``."""

import sys

from p2wss.config.generate import main

if __name__ == "__main__":
    main(*sys.argv[1:])

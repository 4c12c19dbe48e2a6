"""The threads of torch. Imports torch only when it is called."""

from __future__ import annotations

import os


def set_num_threads(num_threads: int) -> None:
    """Limit torch to ``num_threads``. To be called before torch is imported elsewhere.

    On shared cores, OpenMP threads that spin while they wait make small operations 40 times slower.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "0")
    import torch

    torch.set_num_threads(num_threads)

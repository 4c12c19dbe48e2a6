"""The threads of torch. Imports torch only when it is called."""

import os


def set_num_threads(num_threads: int) -> None:
    """Limit torch to ``num_threads``. To be called before torch is imported elsewhere.

    On shared cores, OpenMP threads that spin while they wait make small operations 40 times slower.
    """
    before = dict(os.environ)
    os.environ.update({"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"} | before)
    try:
        import torch
    finally:  # read by the libraries once, when they are loaded
        for name in os.environ.keys() - before.keys():
            del os.environ[name]

    torch.set_num_threads(num_threads)

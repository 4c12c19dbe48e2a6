"""All tests are strict: an error in the code of a run, which users would only find in its log, is raised."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext

import pytest

from p2wss.reconstruction.running.failures import Failures


@pytest.fixture(scope="session", autouse=True)
def strict() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Failures, "met", lambda self: nullcontext())
        yield

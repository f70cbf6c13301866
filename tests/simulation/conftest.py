"""Small blocks of training patches, and the user's own animals, for all tests of the simulation."""

from collections.abc import Iterator

import pytest

from liex_lab.simulation import training_patches


@pytest.fixture(scope="module", autouse=True)
def small_blocks() -> Iterator[None]:
    """Blocks of 64 patches instead of 512; the seeds of blocks do not depend on it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_patches, "BLOCK", 64)
        yield

"""Jobs draw reports; their tests do not look at them closely."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def quick_pictures(coarse_figures: None) -> None:
    """Pictures with one ray a pixel."""

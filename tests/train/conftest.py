"""Recipes draw what they have learned; their tests do not look at it closely."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module", autouse=True)
def quick_pictures(coarse_figures: None) -> None:
    """Pictures with one ray a pixel."""

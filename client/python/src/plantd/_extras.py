"""Packages that are only needed by those who ask for what they do."""

from __future__ import annotations

import importlib
from typing import Any


def needed(module: str, extra: str) -> Any:
    """A module of an optional package; the error says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.split(".")[0]
        raise ImportError(
            f'this needs the package `{package}`: pip install "plantd[{extra}]"'
        ) from None

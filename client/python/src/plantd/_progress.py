"""Progress bars, where somebody looks."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from typing import Any


class _Quiet:
    def update(self, count: float = 1) -> None:
        """Nothing is shown."""

    def set_postfix_str(self, text: str) -> None:
        """Nothing is shown."""


def progress_bar(what: str, total: int | None, wanted: bool | None) -> AbstractContextManager[Any]:
    """A bar of ``tqdm``; nothing where it is not installed, or standard error is no terminal and nobody has
    asked for one."""
    if wanted is False or (wanted is None and not sys.stderr.isatty()):
        return nullcontext(_Quiet())
    try:
        from tqdm.auto import tqdm
    except ImportError:
        if wanted:
            raise ImportError(
                'progress bars need the package `tqdm`: pip install "plantd[progress]"'
            ) from None
        return nullcontext(_Quiet())
    bar: AbstractContextManager[Any] = tqdm(total=total, desc=what, leave=False)
    return bar

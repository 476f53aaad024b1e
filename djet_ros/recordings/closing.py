"""What everything shares that holds files open."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self


class Closing(ABC):
    """Closed by leaving its ``with`` statement, after an error too."""

    @abstractmethod
    def close(self) -> None:
        """Let go of everything."""

    def __enter__(self) -> Self:
        """Give the object itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close it."""
        self.close()

"""
Descriptions of the parameters of a configuration dataclass.

All presentations of parameters (ROS declarations, YAML files, command-line flags, ``help``) are
derived from these, which are given once, next to the default.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from inspect import cleandoc
from textwrap import fill
from typing import Any, TypeVar

Config = TypeVar('Config')


@dataclass(frozen=True)
class Description:
    """
    Meaning and admissible values of a parameter; the text includes the unit.

    numbers: whether it is a text of several numbers, which may be given as a list.
    """

    text: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    odd: bool = False
    numbers: bool = False

    @property
    def explained(self) -> str:
        """Return the text with the choices or the range."""
        if self.choices:
            return f'{self.text} [{" | ".join(self.choices)}]'
        if self.minimum is not None:
            return f'{self.text} [{self.minimum} to {self.maximum}{", odd" if self.odd else ""}]'
        return self.text


def parameter(default: Any, text: str, *, minimum: float | None = None,
              maximum: float | None = None, choices: tuple[str, ...] = (),
              odd: bool = False, numbers: bool = False) -> Any:
    """Declare a dataclass field with its default and its description."""
    description = Description(text, minimum, maximum, choices, odd, numbers)
    return field(default=default, metadata={'description': description})


def describe(config: Any) -> dict[str, Description]:
    """Return the descriptions of the plain (not nested) parameters of a config, by name."""
    return {f.name: f.metadata['description'] for f in fields(config)
            if 'description' in f.metadata}


def documented(config: type[Config]) -> type[Config]:
    """Add the descriptions of its parameters to the docstring of a config, for ``help``."""
    parameters = (fill(f'{name}: {description.explained}', 90, subsequent_indent='    ')
                  for name, description in describe(config).items())
    config.__doc__ = '\n'.join([cleandoc(config.__doc__ or ''), '', *parameters])
    return config


def check(config: Any) -> None:
    """
    Raise ValueError naming the first parameter whose value is outside its description.

    For use in ``__post_init__``: a config that exists is valid.
    """
    for name, description in describe(config).items():
        value = getattr(config, name)
        if description.choices and value not in description.choices:
            raise ValueError(f"{name} is '{value}'; choose from {', '.join(description.choices)}")
        low, high = description.minimum, description.maximum
        # a NaN fails all comparisons, so the condition is what must hold
        if not ((low is None or value >= low) and (high is None or value <= high)):
            raise ValueError(f'{name} is {value}; it must lie between {low} and {high}')
        if description.odd and value % 2 == 0:
            raise ValueError(f'{name} is {value}; it must be odd')

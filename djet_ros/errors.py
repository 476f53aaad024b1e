"""The one exception for what a user can mend."""

from __future__ import annotations

from typing import Any

# Room for a path, a list of choices and advice; what a hostile file says has no more.
LONGEST_LINE = 1000


def one_line(said: object, longest: int = LONGEST_LINE) -> str:
    """Make what another library said, or a file has in it, one short line for a terminal."""
    text = ' '.join(str(said).split()) or type(said).__name__
    if len(text) > longest:
        text = f'{text[:longest // 2]} ... {text[-longest // 2:]}'
    return ''.join(letter if letter.isprintable() else '?' for letter in text)


class DjetError(Exception):
    """
    Something the user gave is wrong and can be mended by the user.

    The message is one line: what was wrong, with the offending value, and what to do about it.
    The terminal prints it as it is and exits with code 2; the live node logs it. Whatever names
    and values from strangers are in it, it is one printable line.
    """

    def __init__(self, text: object) -> None:
        """Make the text a line."""
        super().__init__(one_line(text))

    def __reduce__(self) -> tuple[Any, ...]:
        """
        Pickle the line and the attributes, as a worker sends them.

        Exceptions are rebuilt by their constructor, but that of a subclass takes other arguments.
        """
        return _rebuilt, (type(self), self.args, vars(self))


def _rebuilt(kind: type[DjetError], args: tuple[str], attributes: dict[str, Any]) -> DjetError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(attributes)
    return error

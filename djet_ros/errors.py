"""The one exception for what a user can mend."""


class DjetError(Exception):
    """
    Something the user gave is wrong and can be mended by the user.

    The message is one line: what was wrong, with the offending value, and what to do about it.
    The terminal prints it as it is and exits with code 2; the live node logs it.
    """

"""Order of images by their stamps: late ones, wrong stamps, and time that restarts."""

from __future__ import annotations

# Late images in a row from which on the stamps have gone back for good.
LATE_IN_A_ROW = 10


class Order:
    """
    The newest stamps of one camera, by which the next image is judged.

    max_backwards: seconds by which a late stamp may be older than the newest one; max_gap: largest
    seconds between two consecutive images.
    """

    def __init__(self, max_backwards: float = 0.0, max_gap: float = 0.0) -> None:
        self.newest: int | None = None
        # The one before the newest, if there is no gap between both.
        self._before: int | None = None
        self._late_in_a_row = 0
        self.configure(max_backwards, max_gap)

    def configure(self, max_backwards: float, max_gap: float) -> None:
        """Change the limits, in seconds; the stamps are kept."""
        self._backwards, self._gap = round(max_backwards * 1e9), round(max_gap * 1e9)

    def take(self, stamp_ns: int) -> None:
        """Set the newest stamp, also if time went back to it."""
        together = self.newest is not None and 0 < stamp_ns - self.newest <= self._gap
        self._before = self.newest if together else None
        self.newest = stamp_ns
        self._late_in_a_row = 0

    def follows_gap(self, stamp_ns: int) -> bool:
        """
        Return whether an image comes after a gap of more than max_gap, or has a wrong stamp.

        The image after it decides which.
        """
        return self.newest is not None and stamp_ns - self.newest > self._gap

    def misplaced(self, stamp_ns: int, following_ns: int | None) -> str:
        """
        Return why an image cannot follow the newest one, or an empty string.

        'ahead': only its stamp leaps, but not that of the image after it, following_ns (None if
        unknown); 'equal_stamp' or 'late': it is not newer, and time did not go back to it.
        """
        if self.newest is None:
            return ''
        if (self.follows_gap(stamp_ns) and following_ns is not None
                and following_ns > self.newest and not self.follows_gap(following_ns)):
            return 'ahead'
        if stamp_ns > self.newest:
            return ''
        if stamp_ns == self.newest:
            return 'equal_stamp'
        return '' if self.goes_back(stamp_ns) else 'late'

    def goes_back(self, stamp_ns: int) -> bool:
        """Return whether time went back to a stamp; False if it is newer, or just late."""
        if self.newest is None or stamp_ns >= self.newest:
            return False
        # It follows the stamp before the newest one: the newest one was ahead, and later stamps
        # soon exceed it.
        if self._before is not None and stamp_ns > self._before:
            return False
        self._late_in_a_row += 1
        return (self.newest - stamp_ns > self._backwards
                or self._late_in_a_row >= LATE_IN_A_ROW)

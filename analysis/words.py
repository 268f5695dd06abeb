"""Counts, durations and names of files, for what must not wait for pandas."""

import re
import zlib


def counted(number, word):
    """Write how many there are: "1 run", "9,100 runs"."""
    return f"{number:,.0f} {word}" + ("" if number == 1 else "s")


def duration(seconds):
    """Write how long something takes: "44 s", "14 min", "5.0 h", "1,330 h".

    >>> duration(59.7), duration(3599), duration(18_000), duration(360_000)
    ('1 min', '1.0 h', '5.0 h', '100 h')
    """
    if round(seconds) < 60:
        return f"{seconds:.0f} s"
    if round(seconds / 60) < 60:
        return f"{seconds / 60:.0f} min"
    hours = round(seconds / 3600, 1)
    return f"{hours:,.0f} h" if hours >= 100 else f"{hours:.1f} h"


def slug(text):
    """Turn a label or a noise into a part of a file name; a long one is cut and keeps a hash."""
    name = re.sub(r"[^A-Za-z0-9._=+-]+", "_", text).strip("_")
    return name if len(name) <= 150 else f"{name[:140]}_{zlib.crc32(name.encode()):08x}"

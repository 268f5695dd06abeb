"""Numbers of things in sentences."""


def counted(number, what):
    """Write how many there are: "1 run", "3 runs"."""
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"

"""How analyze.py, evaluate.py and the sweep end on bad input, as the training scripts do."""

import sys


def fail(message, code=2):
    """Exit with one line that says what to do."""
    print("error:", message, file=sys.stderr, flush=True)
    sys.exit(code)

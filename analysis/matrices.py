"""Test conditions of two noises with one number each, such as masses by delays.

RandomDynamics(0.7, 0.7) and RandomActionDelay(2) have one number each; so has every noise whose
arguments without a name are equal. Rates and arguments by name tell matrices apart.
"""

import math
import re
from dataclasses import dataclass

import pandas as pd

from noisy_wrappers import BASELINE

# Of canonical notation: name, numbers, arguments by name
NOISE = re.compile(r"([\w.:]+)\(([-+.\de, ]+?)(, \w+=.*)?\)")
NONE = -math.inf  # the number of a noise that a condition lacks: before all others


@dataclass(frozen=True)
class Matrix:
    """Test conditions, arranged by the numbers of their noises."""

    noises: tuple[str, str]  # "RandomDynamics(x, x)" and "RandomActionDelay(y)"
    cells: dict  # (x, y) -> Configuration

    @property
    def name(self):
        """Both noises in one notation."""
        return " + ".join(self.noises)

    def frame(self, values):
        """Arrange values as a frame, x by y; values: {Configuration: anything}."""
        rows, columns = (sorted(set(numbers)) for numbers in zip(*self.cells, strict=True))
        cells = [[values.get(self.cells.get((x, y))) for y in columns] for x in rows]
        return pd.DataFrame(cells, labels("x", rows), labels("y", columns))


def labels(letter, numbers):
    """Write the numbers of a noise: "none", "x = 0.7"."""
    return ["none" if number == NONE else f"{letter} = {number:g}" for number in numbers]


def matrices(conditions):
    """Return a Matrix for every two noises that were combined with two or more numbers of each.

    conditions: Configurations. Those with one of the noises alone, and the clean one, are its
    edges.
    """
    alone, combined = [], {}
    for condition in conditions:
        parts = list(map(one_number, *condition.texts))
        if len(parts) == 1 and parts[0]:
            alone.append((*parts[0], condition))
        elif len(parts) == 2 and all(parts):
            (first, x), (second, y) = parts
            combined.setdefault((first, second), {})[x, y] = condition
    found = []
    for (first, second), cells in combined.items():
        if min(len(set(numbers)) for numbers in zip(*cells, strict=True)) < 2:
            continue
        if BASELINE in conditions:
            cells[NONE, NONE] = BASELINE
        cells |= {(x, NONE): condition for noise, x, condition in alone if noise == first}
        cells |= {(NONE, y): condition for noise, y, condition in alone if noise == second}
        found.append(Matrix((written(first, "x"), written(second, "y")), cells))
    return found


def one_number(noise, rate):
    """Return what a noise is without its number, and the number; None if it has not just one.

    >>> noise, number = one_number("RandomDynamics(0.7, 0.7, fields=('dof_damping',))", 0.5)
    >>> written(noise, "x"), number
    ("RandomDynamics(x, x, fields=('dof_damping',)) at rate 0.5", 0.7)
    """
    match = NOISE.fullmatch(noise)
    numbers = match[2].split(", ") if match else []
    if len(set(numbers)) != 1:
        return None
    return (match[1], len(numbers), match[3] or "", rate), float(numbers[0])


def written(noise, letter):
    """Write a noise of one_number with a letter for its number."""
    name, count, by_name, rate = noise
    at = "" if rate == 1 else f" at rate {rate}"
    return f"{name}({', '.join([letter] * count)}{by_name}){at}"

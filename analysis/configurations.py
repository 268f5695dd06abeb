"""A configuration: the noises that a run is trained or tested with, and their rates.

Only this module knows how noises and rates are written in tables: several are joined by " + ", and
a rate that changes during training is "1.00 to 0.00".
"""

from dataclasses import dataclass

from noisy_wrappers import WRAPPERS


@dataclass(frozen=True)
class Configuration:
    """Noises in canonical notation, each with its rate; without any it is the baseline."""

    noises: tuple[str, ...] = ()
    rates: tuple[tuple[float, float], ...] = ()  # of each noise: at the start and end of training

    @classmethod
    def read(cls, noises, rates):
        """Read a configuration as config.json has it: rates are numbers, or texts "1.0:0.0"."""
        ends = [[float(end) for end in str(rate).split(":")] for rate in rates]
        return cls(tuple(noises), tuple((rate[0], rate[-1]) for rate in ends))

    @classmethod
    def parse(cls, noise, noise_rate):
        """Read a configuration from a csv file: "A(1.0) + B()" and "0.05 + 1.0:0.0"."""
        if not noise:
            return cls()
        return cls.read(noise.split(" + "), str(noise_rate).split(" + "))

    @property
    def noise(self):
        """The noises as tables have them; the baseline's is empty."""
        return " + ".join(self.noises)

    @property
    def noise_rate(self):
        """The rates as tables and the paper have them: "0.05"; the baseline's is "0.00"."""
        return " + ".join(map(rate_text, self.rates)) or rate_text((0, 0))

    @property
    def is_baseline(self):
        """Whether there is no noise."""
        return not self.noises

    @property
    def wrappers(self):
        """The names of the wrappers, in order."""
        return [noise.partition("(")[0] for noise in self.noises]

    @property
    def kinds(self):
        """What the noises perturb: "observation", "reward", "action" or "dynamics"."""
        return {WRAPPERS[name].kind for name in self.wrappers}

    @property
    def parts(self):
        """The configurations with one of the noises each."""
        pairs = zip(self.noises, self.rates, strict=True)
        return [Configuration((noise,), (rate,)) for noise, rate in pairs]

    def __lt__(self, other):
        """Order by noise, then by rates; the baseline comes first."""
        return (self.noise, self.rates) < (other.noise, other.rates)


BASELINE = Configuration()


def rate_text(rate):
    """Spell a rate (start, end): "0.05" as the paper does, or "1.00 to 0.00"."""
    start, end = (f"{r:.2f}" if round(r, 2) == r else f"{r:g}" for r in rate)
    return start if rate[0] == rate[1] else f"{start} to {end}"


def rate_order(text):
    """Sort key of a noise_rate as tables have it: the numbers in it."""
    ends = [[float(end) for end in rate.split(" to ")] for rate in text.split(" + ")]
    return [(rate[0], rate[-1]) for rate in ends]

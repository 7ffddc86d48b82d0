"""Swept words of the command line, in Hydra's grammar, as what Optuna draws from.

key=interval(low,high)           a number between the two; int(interval(...)): a whole one, both ends included
key=tag(log,interval(low,high))  even in its logarithm
key=range(start,stop,step)       the values that -m would run, stop left out; fractions too
key=choice(a,b,c)  key=a,b,c     one of these
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import optuna
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, QuotedString, RangeSweep
from hydra.errors import HydraException
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence

Value = str | int | float | bool

MOST = 1_000_000
"""Values of a range."""


@dataclass(frozen=True)
class Parameter:
    """A key that a study varies.

    Attributes:
        key: such as `optimizer.lr`, or a group such as `model/apex/likelihood`.
        prefix: "", "+" or "++".
        text: the swept value as it was written.
        distribution: what Optuna draws from.
        words: value -> its text after the equals sign, of a choice.
    """

    key: str
    prefix: str
    text: str
    distribution: BaseDistribution
    words: tuple[tuple[Value, str], ...] = ()

    def word(self, value: Value) -> str:
        """The override that sets a value."""
        for known, text in self.words:
            if type(known) is type(value) and known == value:
                return f"{self.prefix}{self.key}={text}"
        return f"{self.prefix}{self.key}={value!r}"

    def draw(self, trial: optuna.Trial) -> Value:
        """The value of a trial."""
        d = self.distribution
        if isinstance(d, FloatDistribution):
            return trial.suggest_float(self.key, d.low, d.high, step=d.step, log=d.log)
        if isinstance(d, IntDistribution):
            return trial.suggest_int(self.key, d.low, d.high, step=d.step, log=d.log)
        assert isinstance(d, CategoricalDistribution)
        found = trial.suggest_categorical(self.key, d.choices)
        assert found is not None
        return found

    def samples(self) -> list[Value]:
        """Values to check before a study starts: every choice; both ends and the middle of a span of numbers."""
        d = self.distribution
        if isinstance(d, CategoricalDistribution):
            return [value for value, _ in self.words]
        assert isinstance(d, (FloatDistribution, IntDistribution))
        middle = math.sqrt(d.low * d.high) if d.log else (d.low + d.high) / 2
        if d.step is not None and not d.log:
            middle = d.low + d.step * ((d.high - d.low) / d.step // 2)
        values: list[Value] = [d.low, d.high, int(middle) if isinstance(d, IntDistribution) else middle]
        return list(dict.fromkeys(values))

    def holds(self, value: object) -> bool:
        """Whether the span or the list has this value."""
        d = self.distribution
        if isinstance(d, CategoricalDistribution):
            return any(type(known) is type(value) and known == value for known, _ in self.words)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return False
        if isinstance(d, IntDistribution) and not isinstance(value, int):
            return False
        assert isinstance(d, (FloatDistribution, IntDistribution))
        inside = d.low <= value <= d.high
        if not inside or d.step is None:
            return inside
        steps = (value - d.low) / d.step
        return math.isclose(steps, round(steps), abs_tol=1e-9)


def read(words: Sequence[str]) -> tuple[list[str], list[Parameter]]:
    """Divides words of a command line into fixed and swept ones; of several words for one key the last one stays.

    Raises:
        UserError: a word that cannot be read, or a sweep that a study cannot draw from; one sentence.
    """
    latest: dict[str, Override] = {}
    for word in words:
        try:
            override = OverridesParser.create().parse_override(word)
        except HydraException as error:
            raise UserError(sentence(f"'{word}' cannot be read as key=value: {one_line(_first(error))}")) from error
        latest.pop(override.key_or_group, None)
        latest[override.key_or_group] = override
    fixed = [str(o.input_line) for o in latest.values() if not o.is_sweep_override()]
    return fixed, [_parameter(o) for o in latest.values() if o.is_sweep_override()]


def _first(error: Exception) -> str:
    return str(error).splitlines()[0]


def _parameter(override: Override) -> Parameter:
    word = str(override.input_line)
    value: Any = override.value()
    prefix = override.get_key_element().partition(override.key_or_group)[0]
    text = word.partition("=")[2]
    key = override.key_or_group
    if override.package is not None:
        raise UserError(f"{word}: a study varies no group with a package (@): name the key itself.")
    if isinstance(value, IntervalSweep):
        return Parameter(key, prefix, text, _interval(value, word))
    if isinstance(value, RangeSweep):
        return Parameter(key, prefix, text, _range(value, word))
    if isinstance(value, ChoiceSweep):
        return _choice(override, value, prefix, text)
    raise UserError(f"{word}: glob chooses files by a pattern; write choice(...) with the words.")


def _log(sweep: Any, word: str) -> bool:
    unknown = sorted(set(sweep.tags) - {"log"})
    if unknown:
        raise UserError(f"{word}: the tag '{unknown[0]}' is unknown; log is the only one.")
    return "log" in sweep.tags


def _unshuffled(sweep: Any, word: str) -> None:
    if sweep.shuffle:
        raise UserError(f"{word}: shuffle has no meaning here, since the sampler decides on the order: leave it out.")


def _interval(sweep: IntervalSweep, word: str) -> BaseDistribution:
    low, high, log = sweep.start, sweep.end, _log(sweep, word)
    assert low is not None
    assert high is not None
    if not low < high or not math.isfinite(high - low):
        raise UserError(f"{word}: the first number must be below the second, and both finite.")
    if log and low <= 0:
        raise UserError(f"{word}: a logarithm needs numbers above 0.")
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, log=log)
    return FloatDistribution(float(low), float(high), log=log)


def _range(sweep: RangeSweep, word: str) -> BaseDistribution:
    _unshuffled(sweep, word)
    log = _log(sweep, word)
    if sweep.step == 0:
        raise UserError(f"{word}: the step of a range is not 0.")
    values = list(itertools.islice(sweep.range(), MOST + 1))
    if len(values) > MOST:
        raise UserError(f"{word}: a range holds {MOST:,} values at most; write interval(...).")
    if not values:
        raise UserError(f"{word}: this range is empty.")
    low, high, step = min(values), max(values), abs(sweep.step)
    if log and (step != 1 or not isinstance(step, int) or low <= 0):
        raise UserError(f"{word}: log goes with a range of whole numbers above 0 with step 1; or write interval(...).")
    if isinstance(low, int) and isinstance(high, int):
        return IntDistribution(low, high, log=log, step=int(step))
    return FloatDistribution(float(low), float(high), step=float(step))


def _choice(override: Override, sweep: ChoiceSweep, prefix: str, text: str) -> Parameter:
    word = str(override.input_line)
    _unshuffled(sweep, word)
    if sweep.tags:
        raise UserError(f"{word}: a choice takes no tag.")
    pairs = list(_pairs(override))
    texts = [text for _, text in pairs]
    if len(set(texts)) < len(texts):
        raise UserError(f"{word}: name each choice once.")
    distribution = CategoricalDistribution([value for value, _ in pairs])
    return Parameter(override.key_or_group, prefix, text, distribution, tuple(pairs))


def _pairs(override: Override) -> Iterator[tuple[Value, str]]:
    """Each choice as a value that a storage can keep, and as text; lists and dictionaries are kept as text."""
    for element, text in zip(override.sweep_iterator(), override.sweep_string_iterator(), strict=True):
        value = element.text if isinstance(element, QuotedString) else element
        yield (value if isinstance(value, (str, int, float, bool)) else text), text

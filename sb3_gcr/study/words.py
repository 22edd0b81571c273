"""Numbers and names as a sentence or a table has them."""

from __future__ import annotations

import math

import numpy as np

from sb3_gcr.study.contrasts import Contrast

#: Per cent below this are the rounding of sums.
ROUNDING = 1e-9
#: Methods as people call them; others go by their own name.
NAMES = {"ppo": "PPO", "gcr": "GCRPPO", "gcrppo": "GCRPPO"}


def called(method: str) -> str:
    """The name of a method in a sentence."""
    return NAMES.get(method, method)


def change(value: float, relative: bool) -> str:
    """A signed difference: "+14 %", or in the return's own unit."""
    if not relative:
        return signed(value)
    return f"{percent(value, sign=True)} %"


def ends(contrast: Contrast) -> str:
    """The interval, as in "5 to 23"."""
    if contrast.relative:
        return f"{percent(contrast.low)} to {percent(contrast.high)}"
    return f"{number(contrast.low)} to {number(contrast.high)}"


def p_value(p: float) -> str:
    """A p-value with two digits."""
    if math.isnan(p):
        return "–"
    return "<.0001" if p < 1e-4 else f"{p:.2g}" if p < 0.995 else "1"


def percent(share: float, sign: bool = False) -> str:
    """A share in whole per cent; below one per cent with one digit, so that no difference becomes
    0 by rounding.
    """
    value = 100.0 * share
    if abs(value) < ROUNDING:
        return "0"
    if abs(value) >= 0.995:
        return f"{value:+,.0f}" if sign else f"{value:,.0f}"
    return _digits(value, 1, sign)


def number(value: float, digits: int = 3) -> str:
    """A number with three digits, and no exponent where that can be avoided."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if abs(value) >= 10.0**digits:
        return f"{value:,.0f}"
    return _digits(value, digits) if value else "0"


def signed(value: float) -> str:
    """A number with its sign."""
    text = number(value)
    return text if text.startswith("-") or text in ("0", "–") else f"+{text}"


def _digits(value: float, digits: int, sign: bool = False) -> str:
    """So many digits that count, without an exponent unless the number is very small."""
    if abs(value) < 1e-6:
        return f"{value:{'+' if sign else ''}.{digits}g}"
    return np.format_float_positional(
        float(f"{value:.{digits}g}"), trim="-", fractional=False, sign=sign
    )

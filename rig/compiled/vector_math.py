"""Elementary functions that the compiler can turn into vector instructions.

A processor computes four or eight numbers with one vector instruction. The compiler uses these
instructions only for a loop whose passes all do the same: no call of a library and no branch except
a choice between two values. The functions of the C library do not fulfil this. The functions here
are polynomials and quotients of polynomials, and `MATH` offers them under the names of Python's
`math`, so that `variants.variant` can compile a formula with them.

Accuracy (tests/rig/contact/test_vector_law.py): exp, log and atan agree with the C library to
5e-16, expm1 to 1e-15, sin to 1e-13, cos to 3e-13; the inverse cube root is exact to 1e-14.

Source: Cody and Waite, Software Manual for the Elementary Functions (1980), for the reduction of
the argument of exp; Moshier, Methods and Programs for Mathematical Functions (1989) and Cephes 2.9,
for log and atan.
"""

import math

import numpy as np

from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.compiled.variants import module_variant

# exp(x) is computed for x within these limits; a value outside counts as the nearer limit
LARGEST_EXPONENT = 700.0

# 1.5 * 2^52: after the addition of this number the low bits of a double hold the nearest integer
_ROUND = 6755399441055744.0
_LOG2_E = 1.4426950408889634
# ln 2 as a sum of two doubles; the first has so few digits that its product with an integer is
# exact
_LN2 = 6.93147180369123816490e-01
_LN2_REST = 1.90821492927058770002e-10

# layout of a double: 52 bits of mantissa, then the exponent plus 1023
_MANTISSA_BITS = np.int64(52)
_MANTISSA_MASK = np.int64(0xFFFFFFFFFFFFF)
_EXPONENT_OF_ONE = np.int64(0x3FF0000000000000)
# the bits of 2^52: an integer in its mantissa is the same integer as a double, plus 2^52
_TWO_52_BITS = np.int64(0x4330000000000000)
_TWO_52_AND_BIAS = 2.0**52 + 1023.0
_SQRT_2 = 1.4142135623730951

# atan: numerator and denominator of the quotient for arguments up to 0.66 (Cephes)
_P0 = -8.750608600031904122785e-01
_P1 = -1.615753718733365076637e01
_P2 = -7.500855792314704667340e01
_P3 = -1.228866684490136173410e02
_P4 = -6.485021904942025371773e01
_Q0 = 2.485846490142306297962e01
_Q1 = 1.650270098316988542046e02
_Q2 = 4.328810604912902668951e02
_Q3 = 4.853903996359136964868e02
_Q4 = 1.945506571482613964425e02
_TAN_3_8_PI = 2.41421356237309504880
# what the double next to pi / 4 lacks
_PI_4_REST = 3.061616997868383e-17

# the square of an angle up to which the series of sin and cos are used, a little over pi / 2
_QUARTER_TURN_SQUARED = 2.5


@kernel_inlined
def _exp_parts(x):
    """Return (bits, part) with exp(x) = 2^n (1 + part).

    `bits` is n as an addend to the exponent bits of a double.
    """
    x = min(max(x, -LARGEST_EXPONENT), LARGEST_EXPONENT)
    shifted = x * _LOG2_E + _ROUND
    n = shifted - _ROUND
    r = (x - n * _LN2) - n * _LN2_REST
    r2 = r * r
    r4 = r2 * r2
    # the series of exp(r) - 1, grouped in pairs so that several products are computed
    # simultaneously
    part = r + r2 * (
        ((1 / 2 + r * (1 / 6)) + r2 * (1 / 24 + r * (1 / 120)))
        + r4
        * (
            ((1 / 720 + r * (1 / 5040)) + r2 * (1 / 40320 + r * (1 / 362880)))
            + r4 * ((1 / 3628800 + r * (1 / 39916800)) + r2 * (1 / 479001600))
        )
    )
    bits = np.float64(shifted).view(np.int64) << _MANTISSA_BITS
    return bits, part


@kernel_inlined
def exp(x):
    """Return exp(x) within two units of the last digit, for x limited to -700 .. 700."""
    bits, part = _exp_parts(x)
    return np.int64(np.float64(1.0 + part).view(np.int64) + bits).view(np.float64)


@kernel_inlined
def expm1(x):
    """Return exp(x) - 1, for x limited to -700 .. 700."""
    bits, part = _exp_parts(x)
    power_of_two = np.int64(_EXPONENT_OF_ONE + bits).view(np.float64)
    return power_of_two * part + (power_of_two - 1.0)


@kernel_inlined
def log(x):
    """Return ln x for normal x > 0, within 1e-15 (absolute where x is near 1)."""
    bits = np.float64(x).view(np.int64)
    exponent = np.int64((bits >> _MANTISSA_BITS) | _TWO_52_BITS).view(np.float64) - _TWO_52_AND_BIAS
    mantissa = np.int64((bits & _MANTISSA_MASK) | _EXPONENT_OF_ONE).view(np.float64)
    # the mantissa between sqrt(1/2) and sqrt(2)
    high = mantissa > _SQRT_2
    mantissa = 0.5 * mantissa if high else mantissa
    exponent = exponent + 1.0 if high else exponent
    # ln m = 2 (s + s^3 / 3 + s^5 / 5 + ...)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    z = s * s
    z2 = z * z
    z4 = z2 * z2
    p = ((1 / 3 + z * (1 / 5)) + z2 * (1 / 7 + z * (1 / 9))) + z4 * (
        ((1 / 11 + z * (1 / 13)) + z2 * (1 / 15 + z * (1 / 17))) + z4 * (1 / 19 + z * (1 / 21))
    )
    return exponent * _LN2 + (exponent * _LN2_REST + 2.0 * (s + s * (z * p)))


@kernel_inlined
def atan(x):
    """Return the arc tangent within two units of the last digit."""
    size = abs(x)
    base, rest, above, below = atan_parts(size, 1.0)
    t = above / below
    z = t * t
    z *= atan_numerator(z) / atan_denominator(z)
    return math.copysign(base + ((t * z + t) + rest), x)


@kernel_inlined
def atan_parts(y, x):
    """Return (base, rest, above, below) with atan(y / x) = base + rest + atan(above / below).

    y >= 0 and x >= 0, and not both 0. The quotient `above / below` is at most 0.66 in size.
    """
    far = y > _TAN_3_8_PI * x
    middle = y > 0.66 * x
    above = -x if far else (y - x if middle else y)
    below = y if far else (y + x if middle else x)
    base = 0.5 * math.pi if far else (0.25 * math.pi if middle else 0.0)
    rest = 2.0 * _PI_4_REST if far else (_PI_4_REST if middle else 0.0)
    return base, rest, above, below


@kernel_inlined
def atan_numerator(z):
    """Return p of atan(t) = t + t z p / q for z = t^2 up to 0.66^2; q is `atan_denominator`."""
    return (((_P0 * z + _P1) * z + _P2) * z + _P3) * z + _P4


@kernel_inlined
def atan_denominator(z):
    """Return q of `atan_numerator`; it is at least 194."""
    return ((((z + _Q0) * z + _Q1) * z + _Q2) * z + _Q3) * z + _Q4


@kernel_inlined
def power(x, y):
    """Return x^y for x > 0."""
    return exp(y * log(x))


@kernel_inlined
def sin(x):
    """Return the sine of an angle up to a quarter turn, within 1e-13; NaN for a larger angle."""
    z = x * x
    series = -1.0 / 1307674368000.0 + z / 355687428096000.0
    series = 1.0 / 6227020800.0 + z * series
    series = -1.0 / 39916800.0 + z * series
    series = 1.0 / 362880.0 + z * series
    series = -1.0 / 5040.0 + z * series
    series = 1.0 / 120.0 + z * series
    series = -1.0 / 6.0 + z * series
    return x + x * (z * series) if z < _QUARTER_TURN_SQUARED else math.nan


@kernel_inlined
def cos(x):
    """Return the cosine of an angle up to a quarter turn, within 3e-13; NaN for a larger angle."""
    z = x * x
    series = -1.0 / 87178291200.0 + z / 20922789888000.0
    series = 1.0 / 479001600.0 + z * series
    series = -1.0 / 3628800.0 + z * series
    series = 1.0 / 40320.0 + z * series
    series = -1.0 / 720.0 + z * series
    series = 1.0 / 24.0 + z * series
    series = -0.5 + z * series
    return 1.0 + z * series if z < _QUARTER_TURN_SQUARED else math.nan


@kernel_inlined
def inverse_cube_root(u):
    """Return u^(-1/3) to 1e-14 for u = 0.25 .. 4."""
    return inverse_cube_root_near(u, (2.0 + u) / (1.0 + 2.0 * u))


@kernel_inlined
def inverse_cube_root_near(u, z):
    """Return u^(-1/3) to 1e-14 for u = 0.25 .. 4, from z = (2 + u) / (1 + 2 u)."""
    z = _closer_inverse_cube_root(z, 1.0 - u * z * z * z)
    return _closer_inverse_cube_root(z, 1.0 - u * z * z * z)


@kernel_inlined
def _closer_inverse_cube_root(z, error):
    """Return the approximation after z; `error` is 1 - u z^3. The series of (1 - error)^(-1/3)."""
    return z * (1.0 + error * (1 / 3 + error * (2 / 9 + error * (14 / 81))))


# Python's `math` with the functions above; sqrt, copysign and the constants need no replacement
MATH = module_variant(math, exp=exp, expm1=expm1, log=log, atan=atan, pow=power, sin=sin, cos=cos)

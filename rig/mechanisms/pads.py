"""Brake pads: friction over speed, pressure and disc heat, and the hysteresis of their clamp.

`explain` does not look for this cause: its effect on a measured torque is reported as `pad_fade` or
`brake_gain`.

[P1] mu = mu_0 (1 - a (1 - exp(-v / v_1))) (1 - b (1 - exp(-p / p_1)))
          (1 - c (1 - exp(-(T - T_0) / T_1))), T > T_0
[P2] the clamp follows the pressure p with play: p' = min(max(p', p (1 - h)), p (1 + h))

Source: [P1] the form is an assumption (friction of pads falls with speed, pressure and heat: UIC
541-3 has them tested over these); [P2] Coulomb friction in the rigging. Each factor is exactly 1
where its coefficient is 0, p' exactly p.
"""

import math

from rollerrig.rig.compiled.kernel import kernel


@kernel
def friction_share(rim_m_s, pressure_Pa, disc_K, pads):
    """Return mu / mu_0 of pads on discs whose wheel turns at a rim speed [P1]."""
    by_speed = 1.0 + pads.speed_loss * math.expm1(-rim_m_s / pads.speed_scale_m_s)
    by_pressure = 1.0 + pads.pressure_loss * math.expm1(-pressure_Pa / pads.pressure_scale_Pa)
    above_K = max(disc_K - pads.fade_from_K, 0.0)
    by_heat = 1.0 + pads.fade_loss * math.expm1(-above_K / pads.fade_scale_K)
    return by_speed * by_pressure * by_heat


@kernel
def clamped(before_Pa, pressure_Pa, hysteresis):
    """Return the pressure in Pa that clamps the pads, after `before_Pa` [P2]."""
    return min(max(before_Pa, pressure_Pa * (1.0 - hysteresis)), pressure_Pa * (1.0 + hysteresis))
